//! Maps as bytes: the messages that upload them, one after the other, each with its length.

use nesam_engine::Limits;
use nesam_proto::v1 as pb;
use nesam_terrain::WorldMap;
use pb::upload_map_request::Part;
use prost::Message as _;

use crate::convert::{MapBuilder, upload};

/// The bytes of a map.
pub fn map_bytes(map: &WorldMap) -> Vec<u8> {
    let mut bytes = Vec::new();
    for message in upload(map) {
        bytes.extend_from_slice(&message.encode_length_delimited_to_vec());
    }
    bytes
}

/// Version of the map in such bytes; 0 where they are no map.
pub fn map_version(bytes: &[u8]) -> u64 {
    match pb::UploadMapRequest::decode_length_delimited(bytes).ok().and_then(|message| message.part) {
        Some(Part::Header(header)) => header.version,
        Some(Part::Tile(_)) | None => 0,
    }
}

/// The map in such bytes.
///
/// # Errors
/// What is wrong with them.
pub fn map_of(bytes: &[u8], limits: &Limits) -> Result<WorldMap, String> {
    let mut rest = bytes;
    let mut builder: Option<MapBuilder> = None;
    while !rest.is_empty() {
        let message = pb::UploadMapRequest::decode_length_delimited(&mut rest).map_err(|error| error.to_string())?;
        match (message.part, &mut builder) {
            (Some(Part::Header(header)), None) => builder = Some(MapBuilder::new(&header, limits).map_err(|e| e.to_string())?),
            (Some(Part::Tile(tile)), Some(builder)) => builder.add(&tile).map_err(|e| e.to_string())?,
            _ => return Err("is not one header and tiles".into()),
        }
    }
    builder.ok_or("has no header")?.finish().map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use nesam_terrain::{GridGeometry, MapSource};

    use super::*;

    #[test]
    fn analytic_the_version_stands_in_the_header() {
        let header = pb::MapHeader { map_id: "m".into(), version: 7, ..Default::default() };
        let message = pb::UploadMapRequest { part: Some(Part::Header(header)) };
        assert_eq!(map_version(&message.encode_length_delimited_to_vec()), 7);
        assert_eq!((map_version(&[]), map_version(b"no map")), (0, 0));
    }

    #[test]
    fn property_stamp_and_frame_are_kept_and_older_bytes_have_none() {
        let geometry = GridGeometry { origin_m: [0.0; 2], resolution_m: 0.5, width: 2, height: 2 };
        let plain = WorldMap::from_layers("m", 1, geometry, vec![0.0; 4], None).unwrap();
        // Bytes of a map that tells neither are those of before there was a place for them.
        let read = |map: &WorldMap| map_of(&map_bytes(map), &Limits::default()).unwrap();
        assert_eq!(read(&plain).source(), &MapSource::default());
        let source = MapSource { stamp_ns: Some(0), frame: "odom".into() };
        let hash = plain.hash().to_string();
        let told = read(&plain.with_source(source.clone()));
        assert_eq!((told.source(), told.hash()), (&source, hash.as_str()));
    }
}
