//! What a planner asks about places further ahead, of a real server, on the committed soft world.

use std::sync::Arc;

use nesam_navigation::{Forecaster, ReferencePath, ServedForecaster, SoilAhead, Surroundings};
use nesam_plant::Ground;
use nesam_terrain::WorldMap;
use nesam_tests::sample_root;

use crate::stage::{layers, predictor, start};

/// Where the path of `w35` crosses soft mud that falls outwards, and where it is level, m of the path.
const SLOPE_M: f64 = 88.0;
const LEVEL_M: f64 = 20.0;

/// Goal: soft ground on a slope is known to slide before the vehicle is there, by whoever knows the soil, and to leave less room than the rest of the path by whoever knows the
/// map alone. Method: the soil of the map and the true one, tried where the path heads to the south-east and where it heads to the north-west.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_soft_slope_ahead_slides_where_its_soil_is_known() {
    let folder = sample_root().join("worlds/w35");
    let (map, ground) = (Arc::new(WorldMap::load(&folder).unwrap()), Ground::read(&folder).unwrap());
    let vehicle = Arc::new(predictor().bundle().vehicle.clone());
    let (server, mut client) = start().await;
    client.upload_map(&layers(&map)).await.unwrap();
    let path = ReferencePath::of_ood_soil();
    let truth = SoilAhead::along(&mut client, map.id(), &ground, &path, 9.0).await.unwrap();
    let [x, y] = path.point(0.0);
    let mut measured = [0.0; 12];
    (measured[0], measured[1], measured[2], measured[5]) = (x, y, map.height_m(x, y).unwrap() + 0.6, path.heading(0.0));
    let mut slides = Vec::new();
    for (session, told) in [("map", None), ("truth", Some(truth))] {
        let surroundings = Surroundings { map: Arc::clone(&map), vehicle: Arc::clone(&vehicle) };
        let mut model = Forecaster::Served(Box::new(ServedForecaster::open(client.clone(), session, surroundings, told).await.unwrap()));
        for arc_m in [LEVEL_M, SLOPE_M] {
            slides.push(model.slide_m(&measured, &path, arc_m, 2.5).await.unwrap().unwrap());
        }
    }
    let [level, slope, level_known, slope_known] = slides[..] else { panic!("four places") };
    assert!(level < -1.0 && level_known < -1.0, "room where the ground is level: {slides:?}");
    assert!((-0.8..0.0).contains(&slope) && slope_known > slope + 0.5 && slope_known > 0.3, "{slides:?}");
    server.shutdown().await;
}
