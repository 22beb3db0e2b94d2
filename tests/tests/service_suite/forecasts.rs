//! Goal: predictions of a session are held against what came of them, and what they got wrong widens the regions of those to come.

use nesam_adaptation::FORECAST_STEPS;
use nesam_client::v1;
use nesam_evaluation::{adapt_all, check_forecasts};
use nesam_model::RolloutNoise;

use crate::stage::*;

/// First sample with a whole history, where the first prediction that is compared begins.
const FIRST: usize = 31;
/// Steps from one comparison to the next.
const APART: usize = 32;

/// Samples of a vehicle that slides along x on top of its motion, by so much a second, and whose height is measured up to so much too high and too low in turns of
/// 3.2 s, without its velocities telling.
fn displaced(session: &str, recorded: &Recorded, last: usize, slide_m_s: f64, heave_m: f64) -> Vec<v1::Measurement> {
    let moved = |mut message: v1::Measurement, i: usize| {
        let position = message.state.as_mut().unwrap().position_m.as_mut().unwrap();
        position.x += slide_m_s * 0.1 * i as f64;
        position.z += heave_m * (std::f64::consts::PI * i as f64 / APART as f64).cos();
        message
    };
    samples(session, &recorded.drive, last).into_iter().enumerate().map(|(i, message)| moved(message, i)).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_predictions_are_held_against_what_came() {
    let (server, mut client, recorded) = start_on_map().await;
    let opened = open(&mut client, "s", recorded.world.id()).await;
    assert_eq!(opened.forecasts, None);
    let mut stream = client.measure().await.unwrap();
    let last = FIRST + 4 * APART + OPEN_STEPS;
    for i in 0..=last {
        stream.exchange(sample("s", &recorded.drive, i)).await.unwrap();
        if i + 3 > FIRST + APART + OPEN_STEPS {
            let checked = client.session("s").await.unwrap().forecasts.map_or(0, |f| f.checked);
            assert_eq!(checked, ((i - OPEN_STEPS).saturating_sub(FIRST) / APART) as u64, "sample {i}");
        }
        if i == FIRST + APART + OPEN_STEPS {
            // The same prediction by the rollout that answers planners, with the terrain encoded at every pose.
            let only = client.session("s").await.unwrap().forecasts.unwrap();
            let query = candidates("s", &recorded.drive, FIRST, 1, APART);
            let soil = learned(&recorded, FIRST + OPEN_STEPS).0;
            let rollout = offline_by(&fresh_predictor().exactly(), &recorded, FIRST, &query, FIRST, soil);
            for (j, k) in FORECAST_STEPS.into_iter().enumerate() {
                let ([x, y, _], measured) = (rollout.state(0, k - 1).position_m, recorded.drive.states[FIRST + k].position_m);
                let distance = (measured[0] - f64::from(x)).hypot(measured[1] - f64::from(y));
                assert!((only.error_rms_m[j] - distance).abs() < 0.002, "{k}: {} and {distance} m", only.error_rms_m[j]);
                assert!((0.01..1.0).contains(&only.expected_rms_m[j]), "{k}: {} m", only.expected_rms_m[j]);
            }
        }
    }
    // Offline, over the whole drive.
    let predictor = fresh_predictor();
    let noise = RolloutNoise::from_json(predictor.bundle().rollout_noise_json.as_deref().unwrap()).unwrap();
    let (drives, maps) = (vec![recorded.drive.clone()], vec![Some(uploaded(&recorded))]);
    let mut adapted = adapt_all(&predictor, &drives, &maps, &filter_config(), &|_| {}).unwrap();
    check_forecasts(&predictor, &drives, &maps, &noise, &mut adapted);
    let told = client.session("s").await.unwrap().forecasts.unwrap();
    let (at, check) = adapted[0].forecasts[told.checked as usize - 1];
    assert_eq!(at, FIRST + 4 * APART);
    let [offline, served] = [[check.scale(), check.height_scale()], [told.scale, told.height_scale]].map(|scales| scales.map(f64::to_bits));
    assert_eq!(offline, served, "as `nesam evaluate --coverage` has it");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_what_predictions_got_wrong_widens_their_regions() {
    let (server, mut client, recorded) = start_on_map().await;
    let last = FIRST + 3 * APART + OPEN_STEPS;
    let mut told = Vec::new();
    for (session, slide_m_s, heave_m) in [("straight", 0.0, 0.0), ("sliding", 0.4, 0.0), ("heaving", 0.0, 0.1)] {
        open(&mut client, session, recorded.world.id()).await;
        client.feed(displaced(session, &recorded, last, slide_m_s, heave_m)).await.unwrap();
        let mut asked = candidates(session, &recorded.drive, last, 1, APART);
        asked.extras = Some(v1::PredictExtras { covariance: true, ..Default::default() });
        let covariance = client.predict(asked).await.unwrap().extras.covariance;
        let at_end = &covariance[(APART - 1) * 144..];
        told.push((client.session(session).await.unwrap().forecasts.unwrap(), [at_end[0] + at_end[13], at_end[26]].map(f64::from)));
    }
    let [(straight, usual), (sliding, wide), (heaving, high)] = told.try_into().unwrap();
    assert_eq!([&straight, &sliding, &heaving].map(|check| check.checked), [3; 3]);
    // 0.4 m/s over 3.2 s on top of what the model errs by.
    assert!(sliding.error_rms_m[2] > 0.8 && straight.error_rms_m[2] < 0.6, "{sliding:?} {straight:?}");
    assert!(sliding.scale > 3.0 * straight.scale, "{} and {}", sliding.scale, straight.scale);
    assert!(wide[0] > 2.0 * usual[0], "{wide:?} and {usual:?} m²");
    // A height that comes out wrong says nothing of where the vehicle is.
    assert!(heaving.height_scale > 3.0 * straight.height_scale && heaving.height_scale > 3.0 * heaving.scale, "{heaving:?} {straight:?}");
    assert!(high[1] / usual[1] > 2.0 * high[0] / usual[0], "{high:?} and {usual:?} m²");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_prediction_across_a_gap_is_not_compared_and_a_copy_goes_on_with_its_own() {
    let (server, mut client, recorded) = start_on_map().await;
    open(&mut client, "s", recorded.world.id()).await;
    let all = samples("s", &recorded.drive, 200);
    let checked = |session: v1::Session| session.forecasts.map_or(0, |forecasts| forecasts.checked);
    // The first prediction waits for sample 63; 60 to 64 are lost.
    client.feed(all[..60].to_vec()).await.unwrap();
    client.feed(all[65..65 + FIRST + APART + OPEN_STEPS].to_vec()).await.unwrap();
    assert_eq!(checked(client.session("s").await.unwrap()), 0);
    let copy = client.fork_session("s", "copy").await.unwrap();
    assert_eq!(checked(copy), 0);
    let image = client.export_session("s").await.unwrap();
    client.import_session(image.clone(), "moved").await.unwrap();
    let next = 65 + FIRST + APART + OPEN_STEPS;
    for session in ["s", "copy", "moved"] {
        client.feed(vec![sample(session, &recorded.drive, next)]).await.unwrap();
    }
    let told = client.session("s").await.unwrap().forecasts;
    assert_eq!(told.as_ref().map(|forecasts| forecasts.checked), Some(1));
    for session in ["copy", "moved"] {
        assert_eq!(client.session(session).await.unwrap().forecasts, told, "{session}");
    }
    server.shutdown().await;
}
