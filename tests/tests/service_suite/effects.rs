//! Goal: effects that are applied act in one session, in predictions and in the soil filter, are kept by exports, and go again; what the catalogue does not allow is
//! refused and changes nothing. Oracle: the offline predictor with the same effects.

use nesam_client::{Candidates, Client, v1};
use nesam_model::{HistoryStep, RolloutQuery, Variant};
use nesam_physics::SoilCorrection;
use nesam_physics::effects::{Effect, SpeedGain, SteeringOffset};
use tonic::Code;

use crate::stage::*;

fn effect(id: &str, parameters: &[(&str, f64, f64)]) -> v1::Effect {
    let parameter = |(name, value, sd): &(&str, f64, f64)| v1::EffectParameter { name: (*name).into(), value: *value, sd: *sd };
    v1::Effect { id: id.into(), parameters: parameters.iter().map(parameter).collect() }
}

fn both() -> Vec<v1::Effect> {
    vec![effect("steering_offset", &[("second", 0.08, 0.01)]), effect("speed_gain", &[("relative", 0.1, 0.0)])]
}

/// States that the offline predictor with effects gives on the prior of the soil.
fn offline_with(effects: &[Effect], recorded: &Recorded, i: usize, candidates: &Candidates) -> Vec<u32> {
    let drive = &recorded.drive;
    let history: Vec<HistoryStep> = (i - 31..i).map(|j| HistoryStep { state: drive.states[j], control: drive.controls[j] }).collect();
    let query = RolloutQuery {
        history: &history,
        start: drive.states[i],
        controls: &candidates.controls,
        samples: candidates.samples,
        horizon: candidates.horizon,
        map: Some(&recorded.world),
        soil_correction: SoilCorrection::NONE,
        variant: Variant::Full,
        start_time_s: None,
        wheels: None,
    };
    bits(&fresh_predictor().with_effects(effects).rollout(&query).unwrap().states)
}

async fn states(client: &mut Client, candidates: &Candidates, session: &str) -> (Vec<u32>, u32) {
    let prediction = client.predict(Candidates { session: session.into(), ..candidates.clone() }).await.unwrap();
    (bits(&prediction.states), prediction.validity[0])
}

#[tokio::test(flavor = "multi_thread")]
async fn service_effects_act_in_their_session_alone_until_reverted() {
    let (server, mut client, recorded) = start_on_map().await;
    for session in ["s", "other"] {
        open(&mut client, session, recorded.world.id()).await;
        client.feed(samples(session, &recorded.drive, 60)).await.unwrap();
    }
    let query = candidates("s", &recorded.drive, 60, 2, 24);
    let not_learned = v1::Validity::SoilNotLearned as u32;
    let (before, flags) = states(&mut client, &query, "s").await;
    let learned = client.session("s").await.unwrap();
    assert!(learned.effects.is_empty() && learned.provenance.as_ref().unwrap().soil_epoch >= 4 && flags & not_learned == 0);

    let applied = client.apply_effects("s", "a test", both()).await.unwrap();
    assert_eq!((applied.effects.clone(), applied.effects_source.as_str()), (both(), "a test"));
    assert_eq!(applied, client.session("s").await.unwrap());
    assert_eq!(applied.provenance.as_ref().unwrap().soil_epoch, learned.provenance.as_ref().unwrap().soil_epoch + 1);
    assert_eq!(applied.soil_correction.as_ref().unwrap().delta, Some(v1::SoilVector::default()), "the soil begins again from its prior");
    let effects = [Effect::SteeringOffset(SteeringOffset { second: 0.08 }), Effect::SpeedGain(SpeedGain { relative: 0.1 })];
    let (with, flags) = states(&mut client, &query, "s").await;
    assert!(with != before && with == offline_with(&effects, &recorded, 60, &query));
    assert_ne!(flags & not_learned, 0);
    assert_eq!(states(&mut client, &query, "other").await.0, before, "another session of the vehicle stays as it is");

    // It goes on with them: the filter learns another soil, and so does a copy that was exported in between.
    let image = client.export_session("s").await.unwrap();
    client.import_session(image, "copy").await.unwrap();
    let mut soils = Vec::new();
    for session in ["s", "other", "copy"] {
        client.feed((61..=120).map(|i| sample(session, &recorded.drive, i)).collect()).await.unwrap();
        soils.push(client.session(session).await.unwrap().soil_correction.unwrap());
    }
    assert!(soils[0] == soils[2] && soils[0].delta != soils[1].delta && soils[0].delta != Some(v1::SoilVector::default()));
    let query = candidates("s", &recorded.drive, 120, 2, 24);
    assert_eq!(states(&mut client, &query, "s").await, states(&mut client, &query, "copy").await);
    let learned = client.session("s").await.unwrap();
    assert_eq!(client.apply_effects("s", "a test", both()).await.unwrap(), learned, "the same again is nothing");
    let renamed = client.apply_effects("s", "another test", both()).await.unwrap();
    assert_eq!(renamed, v1::Session { effects_source: "another test".into(), ..learned });

    let reverted = client.revert_effects("s").await.unwrap();
    assert!(reverted.effects.is_empty() && reverted.effects_source.is_empty());
    assert_eq!(states(&mut client, &query, "s").await.0, offline_with(&[], &recorded, 120, &query));
    assert_eq!(client.revert_effects("s").await.unwrap(), reverted, "once more is nothing");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_effects_outside_the_catalogue_are_refused() {
    let (server, mut client, _) = driven("s", 30).await;
    let before = client.session("s").await.unwrap();
    let offset = |parameters: &[(&str, f64, f64)]| vec![effect("steering_offset", parameters)];
    let wrong = [
        ("unknown", vec![effect("ghost", &[])], "effects[0]"),
        ("missing", offset(&[]), "effects[0]"),
        ("unknown parameter", offset(&[("second", 0.1, 0.0), ("third", 1.0, 0.0)]), "effects[0]"),
        ("twice", offset(&[("second", 0.1, 0.0), ("second", 0.1, 0.0)]), "effects[0]"),
        ("out of range", offset(&[("second", 7.0, 0.0)]), "effects[0]"),
        ("NaN", offset(&[("second", f64::NAN, 0.0)]), "effects[0]"),
        ("negative sd", offset(&[("second", 0.1, -1.0)]), "effects[0]"),
        ("wide sd", offset(&[("second", 0.1, 1e3)]), "effects[0]"),
        ("the second one", [both(), offset(&[])].concat(), "effects[2]"),
        ("not on a car", [both(), vec![effect("skid_steer_track", &[("metres", 0.3, 0.0)])]].concat(), "effects[2]"),
        (
            "no mass left",
            vec![effect("payload", &[("mass_kg", -500.0, 0.0), ("x_m", 0.0, 0.0), ("y_m", 0.0, 0.0), ("z_m", 0.0, 0.0)]); 6],
            "effects",
        ),
        (
            "too many places",
            (0..5)
                .map(|i| effect("soil_drift", &[("factor_end", 0.9, 0.0), ("begin_s", f64::from(i), 0.0), ("end_s", 50.0, 0.0)]))
                .collect(),
            "effects",
        ),
        ("too many", vec![both()[1].clone(); 17], "effects"),
        ("none", vec![], "effects"),
    ];
    for (what, effects, field) in wrong {
        assert_refused(what, client.apply_effects("s", "", effects).await, Code::InvalidArgument, field);
    }
    assert_refused("a long source", client.apply_effects("s", &"x".repeat(257), both()).await, Code::InvalidArgument, "source");
    assert_refused("nobody", client.apply_effects("nobody", "", both()).await, Code::NotFound, "session_id");
    assert_refused("nobody", client.revert_effects("nobody").await, Code::NotFound, "session_id");
    assert_refused("nobody", client.watch_alarms("nobody").await, Code::NotFound, "session_id");
    assert_eq!(client.session("s").await.unwrap(), before);
    server.shutdown().await;
}
