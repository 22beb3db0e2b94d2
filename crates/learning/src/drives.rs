//! Training drives with their terrain features.
//!
//! The encoders are frozen, so the context c of every measured pose is computed once. A predicted pose near the driven path takes the
//! context interpolated between the two measured poses it lies between: it is looked up by place, not by time, so the future of the
//! drive does not leak into the prediction.

use std::sync::Arc;

use half::f16;
use half::slice::HalfFloatSliceExt;
use nesam_model::HistoryStep;
use nesam_model::dims::{CONTEXT, FEATURES};
use nesam_model::encoder::{EncoderScratch, TerrainEncoders};
use nesam_physics::{Control, VehicleState, WHEELS, wrap_angle};
use nesam_terrain::{Patch, PatchScale, Pose2, WorldMap, sample_patch};
use rayon::prelude::*;

use crate::class_soil::ClassSoil;
use crate::pooling::Pooling;

/// Metres that one radian of heading counts when places are compared.
const METRES_PER_RADIAN: f64 = 2.0;

/// One recorded drive: measured channels only.
#[derive(Clone, Debug)]
pub struct Drive {
    /// Trajectory id.
    pub id: String,
    /// Ground; `None` without a map.
    pub map: Option<Arc<WorldMap>>,
    /// Measured states at the step of the model.
    pub states: Vec<VehicleState<f64>>,
    /// Commands, valid from each sample to the next.
    pub controls: Vec<Control<f64>>,
    /// Measured wheel speeds FL, FR, RL, RR, rad/s, where they are known: for calibration only, no input of the model.
    pub wheel_speed_rad_s: Option<Vec<[f64; WHEELS]>>,
    /// Pooled contexts (samples, width of the pooling), empty until encoded.
    contexts: Vec<f16>,
    /// Semantic features (samples, 16, 16, 18), for the soil prior; empty where contexts are not pooled, whose second half they are.
    semantics: Vec<f16>,
}

/// A place on the driven path: share `1 - share` of sample `at`, `share` of the next one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Sample.
    pub at: usize,
    /// Share of the next sample, 0..=1.
    pub share: f32,
}

impl Drive {
    /// A drive without features yet.
    pub fn new(id: String, map: Option<Arc<WorldMap>>, states: Vec<VehicleState<f64>>, controls: Vec<Control<f64>>) -> Self {
        Self { id, map, states, controls, wheel_speed_rad_s: None, contexts: Vec::new(), semantics: Vec::new() }
    }

    /// The drive seen in a mirror (y becomes -y) over the mirrored `map`: for a vehicle whose two sides are alike, another true drive.
    pub fn mirrored(&self, map: Option<Arc<WorldMap>>) -> Self {
        let states = self.states.iter().map(|s| {
            let ([x, y, z], [roll, pitch, yaw]) = (s.position_m, s.attitude_rad);
            let ([vx, vy, vz], [wx, wy, wz]) = (s.velocity_m_s, s.angular_velocity_rad_s);
            VehicleState {
                position_m: [x, -y, z],
                attitude_rad: [-roll, pitch, -yaw],
                velocity_m_s: [vx, -vy, vz],
                angular_velocity_rad_s: [-wx, wy, -wz],
            }
        });
        let controls = self.controls.iter().map(|c| Control { second: -c.second, ..*c });
        Self::new(format!("{}-mirrored", self.id), map, states.collect(), controls.collect())
    }

    /// Pose of sample `i`.
    pub fn pose(&self, i: usize) -> Pose2 {
        let s = &self.states[i];
        Pose2 { x_m: s.position_m[0], y_m: s.position_m[1], yaw_rad: s.attitude_rad[2] }
    }

    /// What the map says of the soil under sample `i`; `None` without a map or a class.
    pub fn class_soil(&self, i: usize) -> Option<ClassSoil> {
        let [x_m, y_m, _] = self.states[i].position_m;
        ClassSoil::at(self.map.as_deref()?, x_m, y_m)
    }

    /// Steps `from .. to` as history.
    pub fn history(&self, from: usize, to: usize) -> Vec<HistoryStep> {
        (from..to).map(|j| HistoryStep { state: self.states[j], control: self.controls[j] }).collect()
    }

    /// Whether contexts exist (a map, and `encode_drives` was called).
    pub fn has_features(&self) -> bool {
        !self.contexts.is_empty()
    }

    /// Pooled context of sample `i`.
    pub(crate) fn context(&self, i: usize) -> &[f16] {
        let width = self.contexts.len() / self.states.len();
        &self.contexts[i * width..(i + 1) * width]
    }

    /// Semantic features of sample `i`, (16, 16, 18).
    pub(crate) fn semantic(&self, i: usize) -> &[f16] {
        if self.semantics.is_empty() { &self.context(i)[FEATURES..] } else { &self.semantics[i * FEATURES..(i + 1) * FEATURES] }
    }

    /// Where on the path, among samples `first ..= last`, a predicted state is nearest.
    pub fn nearest_place(&self, state: &VehicleState<f64>, first: usize, last: usize) -> Place {
        let offset = |i: usize| {
            let s = &self.states[i];
            let turn = METRES_PER_RADIAN * wrap_angle(state.attitude_rad[2] - s.attitude_rad[2]);
            [state.position_m[0] - s.position_m[0], state.position_m[1] - s.position_m[1], turn]
        };
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let distance = |i: usize| dot(offset(i), offset(i));
        let nearest = (first..=last).min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap_or(first);
        // Project onto the two segments that meet at the nearest sample and keep the better one.
        let project = |from: usize| {
            let (a, b) = (offset(from), offset(from + 1));
            let segment: [f64; 3] = core::array::from_fn(|i| a[i] - b[i]);
            let share = (dot(a, segment) / dot(segment, segment).max(1e-9)).clamp(0.0, 1.0);
            let rest: [f64; 3] = core::array::from_fn(|i| a[i] - share * segment[i]);
            (dot(rest, rest), Place { at: from, share: share as f32 })
        };
        let candidates = [nearest.checked_sub(1).filter(|&p| p >= first), Some(nearest).filter(|&n| n < last)];
        let best = candidates.into_iter().flatten().map(project).min_by(|a, b| a.0.total_cmp(&b.0));
        best.map_or(Place { at: first, share: 0.0 }, |(_, place)| place)
    }
}

/// Computes the contexts of all drives with a map, in parallel; `progress(done)` counts samples.
pub fn encode_drives(
    drives: &mut [Drive],
    encoders: &TerrainEncoders,
    scale: &PatchScale,
    pooling: &Pooling,
    progress: impl Fn(usize) + Sync,
    interrupted: &(dyn Fn() -> bool + Sync),
) {
    drives.par_iter_mut().for_each_init(
        || (Patch::new(), EncoderScratch::default(), vec![0f32; CONTEXT]),
        |(patch, scratch, context), drive| {
            let Some(map) = drive.map.clone().filter(|_| !interrupted()) else { return };
            let samples = drive.states.len();
            // Contexts that are not pooled hold the semantic features already.
            let apart = if pooling.width() == CONTEXT { 0 } else { FEATURES };
            let (mut contexts, mut semantics) = (vec![f16::ZERO; samples * pooling.width()], vec![f16::ZERO; samples * apart]);
            for (i, pooled) in contexts.chunks_exact_mut(pooling.width()).enumerate() {
                sample_patch(&map, drive.pose(i), scale, patch);
                encoders.encode(patch, scratch, context);
                pooled.convert_from_f32_slice(&pooling.mean(context));
                semantics[i * apart..(i + 1) * apart].convert_from_f32_slice(&context[CONTEXT - apart..]);
            }
            (drive.contexts, drive.semantics) = (contexts, semantics);
            progress(samples);
        },
    );
}
