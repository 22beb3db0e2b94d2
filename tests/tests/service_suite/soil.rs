//! Goal: every B transitions update the soil inside the session, and every reply says what is known of it.

use std::sync::{Arc, Mutex};

use nesam_adaptation::FilterConfig;
use nesam_client::{outcome_label, v1};
use nesam_engine::{Command, Engine, Event, Limits, OpenSession, Reply};
use nesam_terrain::WorldMap;

use crate::stage::*;

#[tokio::test(flavor = "multi_thread")]
async fn service_every_reply_carries_soil_and_covariance() {
    let (server, mut client, recorded) = start_on_map().await;
    let opened = open(&mut client, "s", recorded.world.id()).await;
    let prior = opened.soil_correction.unwrap();
    assert_eq!((prior.delta, prior.covariance.len()), (Some(v1::SoilVector::default()), 36));
    let mut watch = client.watch_soil("s").await.unwrap();
    let mut watched = watch.message().await.unwrap().unwrap();
    assert_eq!((watched.soil_epoch, watched.correction.as_ref()), (0, Some(&prior)));

    let buffer = FilterConfig::default().buffer;
    let mut stream = client.measure().await.unwrap();
    let (mut epoch, mut updates) = (0, 0);
    for i in 0..=5 * buffer + OPEN_STEPS {
        let answer = stream.exchange(sample("s", &recorded.drive, i)).await.unwrap();
        // The transition from step j - 1 is known when step j is final, so B of them are full at j = B, 2 B, ...
        let last = i.saturating_sub(OPEN_STEPS);
        let full = last > 0 && last % buffer == 0;
        let gated = outcome_label(&answer) == "GATED";
        assert!(full || !gated, "sample {i}");
        updates += u64::from(full && !gated);
        assert_eq!(answer.soil_epoch, updates, "sample {i}");
        if answer.soil_epoch != epoch {
            epoch = answer.soil_epoch;
            watched = watch.message().await.unwrap().unwrap();
            assert_eq!((watched.soil_epoch, watched.stamp_ns), (epoch, Some(last as i64 * STEP_NS)));
        }
        let soil = answer.soil_correction.as_ref();
        assert_eq!(soil, watched.correction.as_ref(), "sample {i}");
        if i % 7 == 0 || full {
            let session = client.session("s").await.unwrap();
            let provenance = session.provenance.unwrap();
            assert_eq!((soil, provenance.soil_epoch), (session.soil_correction.as_ref(), epoch));
            let named = (answer.history_epoch, answer.map_version, &answer.bundle_hash);
            assert_eq!(named, (provenance.history_epoch, provenance.map_version, &provenance.bundle_hash));
            assert_eq!((watched.map_version, &watched.bundle_hash), (provenance.map_version, &provenance.bundle_hash));
            let prediction = client.predict(candidates("s", &recorded.drive, i, 1, 1)).await.unwrap();
            assert_eq!((soil, prediction.provenance.soil_epoch), (Some(&prediction.soil_correction), epoch));
            assert_eq!(prediction.validity[0] & v1::Validity::SoilNotLearned as u32 != 0, epoch == 0);
        }
    }
    assert!(updates >= 2, "{updates} updates");
    let soil = watched.correction.unwrap();
    assert_ne!(soil.delta, prior.delta);
    let variance = soil.variance.unwrap();
    let diagonal = [variance.k_phi, variance.k_c, variance.n, variance.c_pa, variance.phi_rad, variance.k_shear_m];
    for (r, variance) in diagonal.into_iter().enumerate() {
        assert_eq!(variance, soil.covariance[7 * r], "the variance is the diagonal");
        assert!((0..6).all(|c| (soil.covariance[6 * r + c] - soil.covariance[6 * c + r]).abs() <= 1e-12 * (variance * diagonal[c]).sqrt()));
    }
    assert_eq!(learned(&recorded, 5 * buffer + OPEN_STEPS).1, updates, "the filter of `nesam adapt` made as many");
    server.shutdown().await;
}

/// Goal: what the filter cannot compute is told, once for each buffer, and teaches nothing. Method: a prior so wide that its variance overflows, so that no innovation
/// covariance has a Cholesky factor.
#[test]
fn analytic_a_filter_that_fails_says_so_and_learns_nothing() {
    let recorded = recorded();
    let told = Arc::new(Mutex::new(Vec::new()));
    let sink = Arc::clone(&told);
    let filter = FilterConfig { prior_sd: [1e200; 6], ..filter_config() };
    let buffers = 3;
    let last = buffers * filter.buffer + OPEN_STEPS;
    let mut engine =
        Engine::new(predictor(), Limits::default()).unwrap().with_filter(filter).unwrap().with_events(Box::new(move |event| {
            if let Event::SoilFilterFailed { session, vehicle, reason } = event {
                sink.lock().unwrap().push((session, vehicle, reason));
            }
        }));
    engine.execute(0, &Command::PutMap { map: recorded.world.clone(), base: None }).unwrap();
    let open = OpenSession { session: "s".into(), vehicle: "truck".into(), map: recorded.world.id().into(), ..Default::default() };
    engine.execute(0, &Command::Open(open)).unwrap();
    for i in 0..=last {
        let measurement = engine_sample(&recorded.drive, i);
        let reply = engine.execute(0, &Command::Measure { session: "s".into(), vehicle: None, measurement }).unwrap();
        let Reply::Measured(answer) = reply else { panic!("another reply") };
        assert_eq!((answer.outcome.label(), answer.soil.state.epoch), ("applied", 0), "sample {i}");
    }
    let told = told.lock().unwrap();
    assert_eq!(told.len(), buffers, "{told:?}");
    assert!(
        told.iter().all(|(session, vehicle, reason)| session == "s" && vehicle == "truck" && reason.contains("innovation")),
        "{told:?}"
    );
}

/// Goal: where no colours show what soil is where, a session is less sure of its soil, and comes back as it was. Method: the map of a recorded drive with and without its
/// colours; the session on bare ground goes on under a map that has come by colours since.
#[test]
fn property_on_bare_ground_a_session_is_less_sure_of_the_soil() {
    let recorded = recorded();
    let bare = Arc::new(recorded.world.without_colours());
    let on = |world: &Arc<WorldMap>| {
        let mut engine = Engine::new(predictor(), Limits::default()).unwrap();
        engine.execute(0, &Command::PutMap { map: Arc::clone(world), base: None }).unwrap();
        engine
    };
    let sd = |reply: Reply| {
        let Reply::Session(view) = reply else { panic!("no session") };
        (0..6).map(|i| view.soil.covariance[i][i].sqrt()).collect::<Vec<_>>()
    };
    let mut engines = [on(&recorded.world), on(&bare)];
    let open = OpenSession { vehicle: "v".into(), map: bare.id().into(), ..Default::default() };
    let [seen, unseen] = [0, 1].map(|i| sd(engines[i].execute(0, &Command::Open(open.clone())).unwrap()));
    let soil_sd = *predictor().unseen_soil_sd(&bare).expect("the shipped bundle says how soils differ");
    for i in 0..6 {
        let wider = filter_config().prior_sd[i].hypot(soil_sd[i]);
        assert!((unseen[i] - wider).abs() < 1e-9 && unseen[i] > seen[i], "{i}: {} {}", seen[i], unseen[i]);
    }
    let Reply::Image(image) = engines[1].execute(0, &Command::Export { session: "v".into() }).unwrap() else { panic!("no image") };
    let back = |engine: &mut Engine| engine.execute(0, &Command::Import { image: image.clone(), session: "w".into() });
    assert_eq!(sd(back(&mut engines[1]).unwrap()), unseen);
    let mut coloured = image.clone();
    coloured.map = Some((recorded.world.id().into(), recorded.world.hash().into()));
    let moved = engines[0].execute(0, &Command::Import { image: coloured, session: "w".into() }).unwrap();
    assert_eq!(sd(moved), unseen);
}
