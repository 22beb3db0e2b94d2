//! What every test needs: a predictor, a recorded drive, a running server, a client.

use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use nesam_adaptation::{CalibratedFilter, FilterConfig};
use nesam_client::{Candidates, Client, Prediction, measurement, v1};
use nesam_engine::{PredictExtras, PredictQuery, WheelMeasurement};
use nesam_evaluation::adapt_drive;
use nesam_model::{HistoryStep, ModelBundle, Predictor, Rollout, RolloutQuery, Variant};
use nesam_physics::SoilCorrection;
use nesam_server::{Config, RunningServer, serve};
use nesam_terrain::WorldMap;
use nesam_tests::{sample_root, shipped_bundle};
use nesam_trajectories::{DataRoot, SetQuery, Trajectory};
use prost::bytes::Bytes;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

pub use nesam_navigation::map_layers as layers;

/// Step of the model, ns.
pub const STEP_NS: i64 = 100_000_000;
/// Steps that the reorder window keeps from the soil filter at the rate of the model.
pub const OPEN_STEPS: usize = 2;
/// Test drive of the committed sample.
pub const DRIVE: &str = "n0005";

/// A drive with the world it was driven in.
pub struct Recorded {
    pub drive: Trajectory,
    pub world: Arc<WorldMap>,
}

/// The recorded test drive.
pub fn recorded() -> Recorded {
    let root = DataRoot::open(&sample_root(), None).unwrap();
    let query = SetQuery { trajectories: Some(vec![DRIVE.into()]), ..SetQuery::all("nominal") };
    let drive = root.load_set(&query).unwrap().remove(0);
    let world = root.world(drive.world.as_ref().unwrap()).unwrap();
    Recorded { drive, world }
}

/// The shipped bundle.
fn bundle() -> Arc<ModelBundle> {
    static BUNDLE: OnceLock<Arc<ModelBundle>> = OnceLock::new();
    BUNDLE.get_or_init(|| Arc::new(ModelBundle::load(&shipped_bundle()).unwrap())).clone()
}

/// A predictor that has answered nothing yet.
pub fn fresh_predictor() -> Predictor {
    Predictor::new(bundle()).unwrap()
}

/// The predictor that the servers of this program share, so that terrain is encoded once.
pub fn predictor() -> Arc<Predictor> {
    static PREDICTOR: OnceLock<Arc<Predictor>> = OnceLock::new();
    PREDICTOR.get_or_init(|| Arc::new(fresh_predictor())).clone()
}

/// A server with changed defaults, and a client of it.
pub async fn start_with(change: impl FnOnce(&mut Config)) -> (RunningServer, Client) {
    let mut config = Config::ephemeral();
    change(&mut config);
    let server = serve(config, predictor()).await.unwrap();
    let client = Client::connect(&format!("http://{}", server.grpc_addr)).await.unwrap();
    (server, client)
}

/// A server with defaults on free ports, and a client of it.
pub async fn start() -> (RunningServer, Client) {
    start_with(|_| {}).await
}

/// Opens a session on a map.
pub async fn open(client: &mut Client, session: &str, map: &str) -> v1::Session {
    let request =
        v1::OpenSessionRequest { vehicle_id: "truck".into(), session_id: session.into(), map_id: map.into(), ..Default::default() };
    client.open_session(request).await.unwrap()
}

/// A server that has the recorded map.
pub async fn start_on_map() -> (RunningServer, Client, Recorded) {
    let recorded = recorded();
    let (server, mut client) = start().await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    (server, client, recorded)
}

/// A server with a session on the recorded map that has driven to sample `last`.
pub async fn driven(session: &str, last: usize) -> (RunningServer, Client, Recorded) {
    let (server, mut client, recorded) = start_on_map().await;
    open(&mut client, session, recorded.world.id()).await;
    client.feed(samples(session, &recorded.drive, last)).await.unwrap();
    (server, client, recorded)
}

/// Sample `i` of a drive as a measurement.
pub fn sample(session: &str, drive: &Trajectory, i: usize) -> v1::Measurement {
    let control = drive.controls[i];
    let mut message = measurement(session, i as i64 * STEP_NS, drive.states[i].to_array(), [control.speed_m_s, control.second]);
    message.sequence = i as u64 + 1;
    message
}

/// Sample `i` of a drive as the engine takes it.
pub fn engine_sample(drive: &Trajectory, i: usize) -> nesam_engine::Measurement {
    nesam_engine::Measurement {
        sequence: None,
        boot: None,
        stamp_ns: i as i64 * STEP_NS,
        state: drive.states[i],
        command: drive.controls[i],
        wheels: WheelMeasurement::default(),
    }
}

/// The candidates of [`candidates`] as the engine takes them, without extras.
pub fn engine_query(session: &str, drive: &Trajectory, i: usize, samples: usize, horizon: usize) -> PredictQuery {
    PredictQuery {
        session: session.into(),
        start: None,
        instant: None,
        use_history: true,
        samples,
        samples_min: 0,
        horizon,
        controls: nesam_engine::Candidates::Given(candidates(session, drive, i, samples, horizon).controls),
        cost: None,
        extras: PredictExtras::default(),
    }
}

/// Samples `0..=last` of a drive.
pub fn samples(session: &str, drive: &Trajectory, last: usize) -> Vec<v1::Measurement> {
    (0..=last).map(|i| sample(session, drive, i)).collect()
}

/// Candidates around the recorded commands after sample `i`: sample n steers `n * 0.02` more to the left, within the card.
pub fn candidates(session: &str, drive: &Trajectory, i: usize, samples: usize, horizon: usize) -> Candidates {
    let controls = (0..samples)
        .flat_map(|n| {
            (0..horizon).flat_map(move |k| {
                let control = drive.controls[i + k];
                [control.speed_m_s as f32, (control.second as f32 + 0.02 * n as f32).clamp(-1.0, 1.0)]
            })
        })
        .collect();
    Candidates::new(session, samples, horizon, controls)
}

/// Settings of the soil filter that the servers run.
pub fn filter_config() -> FilterConfig {
    CalibratedFilter::config_of(bundle().soil_filter_json.as_deref()).unwrap()
}

/// The recorded world as the servers have it: a map that was uploaded tells no classes of ground.
pub fn uploaded(recorded: &Recorded) -> Arc<WorldMap> {
    let world = &recorded.world;
    Arc::new(WorldMap::from_layers(world.id(), 1, *world.geometry(), world.elevation_m(), world.semantic_rgb()).unwrap())
}

/// The soil correction that the filter of `nesam adapt` has learned from what is final when sample `i` is the newest, and the number of updates.
pub fn learned(recorded: &Recorded, i: usize) -> (SoilCorrection, u64) {
    let filtered = adapt_drive(&fresh_predictor(), &recorded.drive, Some(&uploaded(recorded)), &filter_config()).unwrap();
    let i = i.saturating_sub(OPEN_STEPS);
    let updates = filtered.updates.iter().filter(|u| u.sample <= i && !u.update.rejected).count();
    (filtered.correction_at(i), updates as u64)
}

/// What the offline rollout gives after sample `i` with this soil, from a predictor that has answered nothing else, on the map read from the file.
pub fn offline(recorded: &Recorded, i: usize, candidates: &Candidates, history_steps: usize, soil_correction: SoilCorrection) -> Rollout {
    offline_by(&fresh_predictor(), recorded, i, candidates, history_steps, soil_correction)
}

/// The same from this predictor.
pub fn offline_by(
    predictor: &Predictor,
    recorded: &Recorded,
    i: usize,
    candidates: &Candidates,
    history_steps: usize,
    soil_correction: SoilCorrection,
) -> Rollout {
    let drive = &recorded.drive;
    let history: Vec<HistoryStep> =
        (i - history_steps..i).map(|j| HistoryStep { state: drive.states[j], control: drive.controls[j] }).collect();
    predictor
        .rollout(&RolloutQuery {
            history: &history,
            start: drive.states[i],
            controls: &candidates.controls,
            samples: candidates.samples,
            horizon: candidates.horizon,
            map: Some(&recorded.world),
            soil_correction,
            variant: Variant::Full,
            start_time_s: None,
            wheels: None,
        })
        .unwrap()
}

/// Random payloads of 1 to 300 bytes, the same for the same seed.
pub fn garbage(seed: u64, count: usize) -> Vec<Bytes> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut payload = || -> Bytes { (0..random.random_range(1..300)).map(|_| random.random_range(0..=255_u8)).collect() };
    (0..count).map(|_| payload()).collect()
}

/// Bits of the numbers, so that equality means equality.
pub fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

/// Asserts that a prediction is the rollout, bit for bit.
pub fn assert_same(prediction: &Prediction, rollout: &Rollout) {
    assert_eq!((prediction.samples, prediction.steps), (rollout.samples, rollout.horizon));
    assert!(bits(&prediction.states) == bits(&rollout.states), "states differ");
    assert!(bits(&prediction.sinkage_m) == bits(&rollout.sinkage_m), "sinkages differ");
    // What the service knows beyond the rollout.
    let learned = if prediction.provenance.soil_epoch == 0 { v1::Validity::SoilNotLearned as u32 } else { 0 };
    assert!(prediction.validity.iter().zip(&rollout.flags).all(|(got, flags)| *got == flags | learned));
    assert_eq!(prediction.validity.len(), rollout.flags.len());
    assert_eq!(prediction.soil.map(f64::to_bits), rollout.soil.map(f64::to_bits));
}

/// Asks again until the answer is as expected, at most this long.
pub async fn eventually<F: Future<Output = bool>>(within: Duration, what: &str, mut holds: impl FnMut() -> F) {
    let start = Instant::now();
    while !holds().await {
        assert!(start.elapsed() < within, "{what}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

/// Asserts that a call was refused with this code and names this field.
pub fn assert_refused<T: core::fmt::Debug>(what: &str, result: Result<T, nesam_client::ClientError>, code: tonic::Code, field: &str) {
    let error = result.expect_err(what);
    assert_eq!(error.code(), Some(code), "{what}: {error}");
    assert_eq!(error.field(), field, "{what}: {error}");
    assert!(error.to_string().len() > 20, "{what}: {error}");
}
