//! Maps for the service.

use nesam_client::MapLayers;
use nesam_terrain::WorldMap;

/// A map as a client uploads it, as version 1.
pub fn map_layers(map: &WorldMap) -> MapLayers {
    let (geometry, source) = (map.geometry(), map.source());
    MapLayers {
        id: map.id().into(),
        version: 1,
        origin_m: geometry.origin_m,
        resolution_m: geometry.resolution_m,
        width: geometry.width,
        height: geometry.height,
        elevation_m: map.elevation_m(),
        semantic_rgb: map.semantic_rgb(),
        stamp_ns: source.stamp_ns,
        frame: source.frame.clone(),
    }
}
