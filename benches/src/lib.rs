//! What the service does over and over, each piece ready to be repeated: criterion times it (`benches/benches`), `tests/tools/instructions.py` counts its
//! instructions through the program `counted`.
#![forbid(unsafe_code)]

use std::hint::black_box;
use std::path::PathBuf;
use std::sync::Arc;

use nesam_adaptation::{BufferedTransition, CalibratedFilter, FORECAST_STEPS, FilterConfig, SoilFilter};
use nesam_model::dims::CONTEXT;
use nesam_model::encoder::{EncoderScratch, TerrainEncoders};
use nesam_model::{HistoryStep, ModelBundle, Predictor, RolloutQuery, SoilByClass, Variant};
use nesam_physics::{SoilCorrection, VehicleState};
use nesam_terrain::{Patch, Pose2, WorldMap, sample_patch};
use nesam_trajectories::{DataRoot, SetQuery};

/// A piece of work, repeated by calling it.
pub type Work = Box<dyn FnMut()>;

/// Pieces whose instructions are counted, by name. Making one loads what it needs, which takes a minute where instructions are counted; so they are few.
pub const WORKS: [(&str, fn() -> Work); 4] = [
    ("crop", crop),
    ("encode", encode),
    // Without a map, as encoding one would be counted for minutes.
    ("rollout-16-without-map", || rollout(16, None)),
    ("soil-update", || soil_update(false)),
];

/// Where patches are cropped and rollouts begin, on w05 of the sample.
const POSE: Pose2 = Pose2 { x_m: 3.2, y_m: -4.1, yaw_rad: 0.7 };

/// Sample of the drive at which a buffer of the soil filter begins.
const BUFFER_START: usize = 60;

/// A folder of the repository.
fn repository(folder: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/..")).join(folder)
}

fn sample_root() -> PathBuf {
    repository("tests/data/chrono_sample")
}

fn bundle() -> ModelBundle {
    ModelBundle::load(&repository("deploy/bundles/hmmwv-nominal")).expect("a shipped bundle")
}

/// A map of the sample.
pub fn map() -> WorldMap {
    WorldMap::load(&sample_root().join("worlds/w05")).expect("a map of the sample")
}

/// One pair of patches cropped.
pub fn crop() -> Work {
    let (map, scale, mut patch) = (map(), bundle().normalization.patch_scale(), Patch::new());
    Box::new(move || sample_patch(&map, POSE, &scale, black_box(&mut patch)))
}

/// One pair of patches encoded.
pub fn encode() -> Work {
    let bundle = bundle();
    let encoders = TerrainEncoders::new(&bundle.weights).expect("its encoders");
    let (mut patch, mut scratch, mut context) = (Patch::new(), EncoderScratch::default(), vec![0.0; CONTEXT]);
    sample_patch(&map(), POSE, &bundle.normalization.patch_scale(), &mut patch);
    Box::new(move || {
        encoders.encode(&patch, &mut scratch, &mut context);
        black_box(&context);
    })
}

/// A query of `samples` candidates and 32 steps, its terrain warm.
pub fn rollout(samples: usize, map: Option<Arc<WorldMap>>) -> Work {
    let predictor = Predictor::new(Arc::new(bundle())).expect("a complete bundle");
    let mut start = VehicleState::zero();
    let ground_m = map.as_ref().map_or(0.0, |map| map.nearest_height_m(POSE.x_m, POSE.y_m));
    start.position_m = [POSE.x_m, POSE.y_m, ground_m + 0.6];
    start.velocity_m_s[0] = 2.5;
    let controls: Vec<f32> = (0..samples * 32).flat_map(|i| [2.5, 0.6 * (i as f32 * 0.01).sin()]).collect();
    let ask = move || {
        let query = RolloutQuery {
            history: &[],
            start,
            controls: &controls,
            samples,
            horizon: 32,
            map: map.as_ref(),
            soil_correction: SoilCorrection::NONE,
            variant: Variant::Full,
            start_time_s: None,
            wheels: None,
        };
        black_box(predictor.rollout(&query).expect("a valid query"));
    };
    ask();
    Box::new(ask)
}

/// A recorded drive of the sample and what a filter of the shipped bundle needs to learn from it.
struct Buffer {
    predictor: Predictor,
    map: Arc<WorldMap>,
    steps: Vec<HistoryStep>,
    config: FilterConfig,
}

impl Buffer {
    fn new() -> Self {
        let bundle = bundle();
        let config = CalibratedFilter::config_of(bundle.soil_filter_json.as_deref()).expect("settings of a shipped bundle");
        let predictor = Predictor::new(Arc::new(bundle)).expect("a complete bundle");
        let root = DataRoot::open(&sample_root(), None).expect("the sample");
        let query = SetQuery { trajectories: Some(vec!["n0005".into()]), ..SetQuery::all("nominal") };
        let drive = root.load_set(&query).expect("drives of the sample").into_iter().next().expect("one drive");
        let map = root.world(drive.world.as_deref().expect("a world")).expect("its map");
        let steps = drive.states.iter().zip(&drive.controls).map(|(&state, &control)| HistoryStep { state, control }).collect();
        Self { predictor, map, steps, config }
    }

    /// The network along the buffer, nothing learned yet.
    fn transitions(&self) -> Vec<BufferedTransition> {
        self.transitions_from(BUFFER_START, Vec::new())
    }

    /// The network along the buffer that begins at a step, on soils that were learned.
    fn transitions_from(&self, start: usize, learned: Vec<SoilCorrection>) -> Vec<BufferedTransition> {
        let along = SoilByClass::new(Some(&self.map), learned);
        let range = start..start + self.config.buffer;
        let transitions = self.predictor.measured_transitions(&self.steps, range, Some(&along), &self.map).expect("a drive on its map");
        let ended = transitions.into_iter().zip(&self.steps[start + 1..]);
        let at = |[x, y, _]: [f64; 3]| SoilByClass::class_at(Some(&self.map), [x, y]);
        ended
            .map(|(t, end)| {
                let ground_class = at(t.input.state.position_m);
                BufferedTransition { ground_class, ..BufferedTransition::new(t.input, t.residual, &end.state) }
            })
            .collect()
    }
}

/// The network along one buffer of the soil filter.
pub fn network_along_buffer() -> Work {
    let buffer = Buffer::new();
    Box::new(move || {
        black_box(buffer.transitions());
    })
}

/// One prediction held against what came of it.
pub fn forecast_held() -> Work {
    let buffer = Buffer::new();
    Box::new(move || {
        let soil = SoilByClass::new(Some(&buffer.map), Vec::new());
        black_box(buffer.predictor.forecast_errors(&buffer.steps, BUFFER_START, FORECAST_STEPS, &soil, &buffer.map)).expect("on its map");
    })
}

/// The next update of a soil filter that goes through a recorded drive again and again; each time it begins afresh. The mean over many is what an update costs.
pub fn next_soil_update() -> Work {
    let buffer = Buffer::new();
    let fresh = SoilFilter::new(buffer.config.clone()).expect("usable settings");
    let mut filter = fresh.clone();
    let mut buffers = Vec::new();
    for start in (0..buffer.steps.len() - buffer.config.buffer).step_by(buffer.config.buffer) {
        let transitions = buffer.transitions_from(start, filter.estimates());
        for transition in &transitions {
            filter.push(buffer.predictor.step_model(), *transition).expect("finite numbers");
        }
        buffers.push(transitions);
    }
    let (predictor, mut next) = (buffer.predictor, 0);
    Box::new(move || {
        if next == 0 {
            filter.clone_from(&fresh);
        }
        for transition in &buffers[next] {
            black_box(filter.push(predictor.step_model(), *transition).expect("finite numbers"));
        }
        next = (next + 1) % buffers.len();
    })
}

/// One update of a fresh soil filter; the literal algorithm is given the same transitions, as what it costs does not depend on where they start.
pub fn soil_update(literal: bool) -> Work {
    let buffer = Buffer::new();
    let transitions = buffer.transitions();
    let config = if literal { FilterConfig::literal() } else { buffer.config };
    let (fresh, predictor) = (SoilFilter::new(config).expect("usable settings"), buffer.predictor);
    Box::new(move || {
        let mut filter = fresh.clone();
        for transition in &transitions {
            black_box(filter.push(predictor.step_model(), *transition).expect("finite numbers"));
        }
    })
}
