//! Goal: a car that sets off teaches the soil filter nothing until it drives as the card knows it, and then as it should.
//! Method: the simulated vehicle of `nesam-plant`, which shares no code with the physics, parks for half a second on soft ground and drives straight ahead; the server is
//! fed with it.

use std::sync::Arc;

use nesam_evaluation::{adapt_drive, history_steps};
use nesam_physics::{Control, VehicleState};
use nesam_plant::{Command, Ground, HiddenEffects, Plant, PlantVehicle};
use nesam_tests::sample_root;
use nesam_trajectories::{DataRoot, Trajectory};

use crate::stage::*;

/// Samples before the car is told to drive, and when it has driven for eight seconds.
const PARKED: usize = 5;
const LAST: usize = 85;

/// A drive from rest on a world.
fn set_off(world: &str) -> Recorded {
    let folder = sample_root().join("worlds").join(world);
    let vehicle = Arc::new(PlantVehicle::of_root(&sample_root()).unwrap());
    let mut plant = Plant::at_rest(vehicle, Arc::new(Ground::read(&folder).unwrap()), HiddenEffects::default(), -15.0, 0.0, 0.0);
    let told = |k: usize| if k < PARKED { 0.0 } else { 3.0 };
    for _ in 0..10 {
        plant.advance(Command { speed_m_s: 0.0, steering: 0.0 });
    }
    let Recorded { drive, .. } = recorded();
    let states = (0..drive.states.len()).map(|k| {
        let state = VehicleState::from_array(plant.truth().state);
        plant.advance(Command { speed_m_s: told(k), steering: 0.0 });
        state
    });
    let states = states.collect();
    let controls = (0..drive.controls.len()).map(|k| Control { speed_m_s: told(k), second: 0.0 }).collect();
    let map = DataRoot::open(&sample_root(), None).unwrap().world(world).unwrap();
    Recorded { drive: Trajectory { states, controls, world: Some(world.into()), ..drive }, world: map }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_car_that_sets_off_teaches_once_it_drives() {
    let recorded = set_off("w35");
    let predictor = fresh_predictor();
    let steps = history_steps(&recorded.drive);
    let sets_off: Vec<usize> = (0..LAST).filter(|k| predictor.sets_off(&steps[..*k], &steps[*k])).collect();
    assert!(sets_off.first() == Some(&PARKED) && (2..=10).contains(&sets_off.len()), "told at {PARKED}, sets off at {sets_off:?}");
    let driving = sets_off.last().unwrap() + 1;
    assert!(recorded.drive.states[driving].velocity_m_s[0] > 1.0, "{:?}", recorded.drive.states[driving].velocity_m_s);
    let filtered = adapt_drive(&predictor, &recorded.drive, Some(&uploaded(&recorded)), &filter_config()).unwrap();
    let first = filtered.updates[0].sample;
    assert_eq!(first, driving + filter_config().buffer, "the first buffer begins where it drives");

    let (server, mut client) = start().await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "s", recorded.world.id()).await;
    client.feed(samples("s", &recorded.drive, LAST)).await.unwrap();
    let asked = candidates("s", &recorded.drive, LAST, 3, 8);
    let prediction = client.predict(asked.clone()).await.unwrap();
    let (soil, updates) = learned(&recorded, LAST);
    assert!(bits(&prediction.states) == bits(&offline(&recorded, LAST, &asked, 31, soil).states), "as `nesam adapt` would have learned");
    assert_eq!(prediction.provenance.soil_epoch, updates);
    println!("learned of ground that is three times softer than it looks: {:.2?} in {updates} updates", soil.delta);
    assert!(soil.delta[0] < 0.0, "k_phi is to fall: {:?}", soil.delta);
    server.shutdown().await;
}
