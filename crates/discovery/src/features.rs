//! What a whole drive says: a short vector of robust statistics of its segments, the unit that is compared with drives without an effect.
//!
//! * The *mean* deviation of every channel over the segments (Huber 1964: segments beyond a few standard deviations have a bounded say). The rims are
//!   taken as their mean and as differences between wheels, because throttle moves all of them together.
//! * For each column of the linear catalogue, the *matched* variation: how far the deviations rise and fall over the drive as that column predicts, means
//!   removed. A mass up high shows in roll while turning, not in any mean.
//!
//! Soil, roughness and model error vary between drives; they are measured as the scatter of these statistics over null drives instead of
//! being modelled.

use nalgebra::{DMatrix, DVector};
use nesam_evaluation::median;
use nesam_physics::step::StepModel;
use nesam_physics::{SOIL_DIM, SoilCorrection, Vehicle};
use rayon::prelude::*;

use crate::candidates::{COLUMNS, Candidate};
use crate::channels::{self, CHANNELS, RIM_AT, Row, STATE_CHANNELS, STEERING_AT};
use crate::observe::ObservedDrive;

/// Statistics of a drive: a mean per channel and a matched variation per column of the catalogue.
pub const FEATURES: usize = CHANNELS + COLUMNS;
/// Standard deviations of one segment beyond which a deviation has no further say.
const CUT_OFF: f64 = 3.0;
/// Standard deviation of a normal variable per median distance from its median.
const NORMAL_PER_MEDIAN: f64 = 1.4826;
/// Prior standard deviation of a soil correction common to a set, logarithmic coordinates: ln k_phi, ln k_c, n, ln c, phi (rad), ln k_shear.
/// Chosen from the spread of Wong's published soils within a class of ground.
pub const SOIL_SD: [f64; SOIL_DIM] = [0.5, 0.5, 0.1, 0.5, 0.07, 0.35];

/// Step and sub-steps of the physics.
#[derive(Clone, Copy, Debug)]
pub struct Stepping {
    /// Step, s.
    pub dt_s: f64,
    /// Sub-steps.
    pub substeps: usize,
}

impl Stepping {
    /// The physics of a vehicle.
    pub fn model(&self, vehicle: &Vehicle) -> StepModel {
        StepModel::new(vehicle, self.dt_s, self.substeps)
    }
}

/// A drive with everything that does not depend on which drives it is judged with.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// For each column of the catalogue, the weight of each segment's channels in its matched variation.
    filters: Vec<Vec<Row>>,
    /// Robust standard deviation of one segment, by channel.
    scale: Row,
    /// Statistics with the reference vehicle.
    pub statistics: DVector<f64>,
    /// How an effect of unit share shifts the statistics: one row per column of the catalogue.
    pub signature: DMatrix<f64>,
    /// How a soil correction of one prior standard deviation in the ground would shift them: one row per soil parameter.
    pub soil: DMatrix<f64>,
}

/// Names of the statistics.
pub fn names() -> Vec<String> {
    let contrasts = ["rims_m_s", "rims_front_left_right_m_s", "rims_rear_left_right_m_s", "rims_front_rear_m_s"];
    let means = (0..CHANNELS).map(|c| if c < RIM_AT { channels::name(c) } else { contrasts[c - RIM_AT].into() });
    let labels = Candidate::ALL.iter().flat_map(|c| c.columns().map(move |j| format!("matched {} {}", c.label(), j - c.columns().start)));
    means.chain(labels).collect()
}

/// Residual layer of a statistic.
pub fn layer(statistic: usize) -> &'static str {
    if statistic < CHANNELS { channels::layer(statistic) } else { "matched" }
}

/// Means that are compared, as (first or second half of a segment, state channel): the others repeat these or show no effect of the catalogue, and every
/// statistic costs certainty, because some thirty null drives must tell how all of them scatter together.
const STATE_MEANS: [(usize, usize); 7] = [(0, 8), (0, 10), (1, 2), (1, 3), (1, 4), (1, 5), (1, 6)];

/// Which statistics of a drive are compared, given what it measures. The common speed of the rims is not (it follows throttle and soil), nor the matched
/// variations of effects whose means say it all; the matched variations need every state channel.
pub fn usable(available: &[bool; CHANNELS]) -> [bool; FEATURES] {
    let rims = available[RIM_AT..].iter().all(|a| *a);
    let states = available[..STEERING_AT].iter().all(|a| *a);
    core::array::from_fn(|f| match f {
        f if f < STEERING_AT => available[f] && STATE_MEANS.contains(&(f / STATE_CHANNELS, f % STATE_CHANNELS)),
        STEERING_AT => available[f],
        f if f < CHANNELS => rims && f > RIM_AT,
        f => states && Candidate::Payload.columns().contains(&(f - CHANNELS)),
    })
}

/// Robust standard deviation of a segment's deviations within drives, by channel: the mean over drives.
pub fn segment_scale(rows: &[Vec<Row>]) -> Row {
    core::array::from_fn(|c| {
        let sum: f64 = rows
            .iter()
            .map(|rows| {
                let values: Vec<f64> = rows.iter().map(|r| r[c]).collect();
                let middle = median(&values);
                median(&values.iter().map(|v| (v - middle).abs()).collect::<Vec<_>>())
            })
            .sum();
        (NORMAL_PER_MEDIAN * sum / rows.len().max(1) as f64).max(1e-8)
    })
}

/// Prepares a drive: its matched filters, its statistics and how each column of the catalogue would shift them.
pub fn prepare(scale: &Row, vehicle: &Vehicle, stepping: Stepping, drive: &ObservedDrive) -> Prepared {
    let at = |effect: &nesam_physics::effects::Effect, share: f64| {
        drive.deviations(&stepping.model(&vehicle.with_effects(&[effect.scaled(share)])), &SoilCorrection::NONE)
    };
    let effects: Vec<_> = Candidate::ALL.iter().flat_map(|c| c.linear_form()).collect();
    assert_eq!(effects.len(), COLUMNS, "the linear forms fill the columns; this is a bug");
    let sides: Vec<[Vec<Row>; 2]> = effects.par_iter().map(|e| [at(e, 1.0), at(e, -1.0)]).collect();
    let mut prepared = Prepared {
        filters: sides.iter().map(|[more, less]| filter(more, less, scale)).collect(),
        scale: *scale,
        statistics: DVector::zeros(FEATURES),
        signature: DMatrix::zeros(COLUMNS, FEATURES),
        soil: DMatrix::zeros(SOIL_DIM, FEATURES),
    };
    prepared.statistics = prepared.of(&drive.deviations(&stepping.model(vehicle), &SoilCorrection::NONE));
    for (column, [more, less]) in sides.iter().enumerate() {
        let shift = (prepared.of(less) - prepared.of(more)) * 0.5;
        prepared.signature.row_mut(column).copy_from(&shift.transpose());
    }
    let model = stepping.model(vehicle);
    let other_soil = |i: usize, share: f64| {
        let mut soil = SoilCorrection::NONE;
        soil.delta[i] = share * SOIL_SD[i];
        prepared.of(&drive.deviations(&model, &soil))
    };
    let shifts: Vec<DVector<f64>> = (0..SOIL_DIM).into_par_iter().map(|i| other_soil(i, -0.5) - other_soil(i, 0.5)).collect();
    for (i, shift) in shifts.iter().enumerate() {
        prepared.soil.row_mut(i).copy_from(&shift.transpose());
    }
    prepared
}

/// Variation of a column over the segments, mean removed, in standard deviations and per standard deviation.
fn filter(more: &[Row], less: &[Row], scale: &Row) -> Vec<Row> {
    let mut rows: Vec<Row> = more
        .iter()
        .zip(less)
        .map(|(m, l)| core::array::from_fn(|c| if c < STEERING_AT { 0.5 * (l[c] - m[c]) / scale[c] } else { 0.0 }))
        .collect();
    let count = rows.len() as f64;
    for c in 0..STEERING_AT {
        let mean = rows.iter().map(|r| r[c]).sum::<f64>() / count;
        rows.iter_mut().for_each(|r| r[c] = (r[c] - mean) / count);
    }
    rows
}

impl Prepared {
    /// Statistics of deviations of this drive.
    pub fn of(&self, rows: &[Row]) -> DVector<f64> {
        let mut out = DVector::zeros(FEATURES);
        let mut means = [0.0; CHANNELS];
        for c in 0..CHANNELS {
            let values: Vec<f64> = rows.iter().map(|r| r[c] / self.scale[c]).collect();
            let middle = median(&values);
            let cut = |v: f64| middle + (v - middle).clamp(-CUT_OFF, CUT_OFF);
            means[c] = values.iter().map(|v| cut(*v)).sum::<f64>() / values.len() as f64 * self.scale[c];
            if c < STEERING_AT {
                for (j, filter) in self.filters.iter().enumerate() {
                    out[CHANNELS + j] += filter.iter().zip(&values).map(|(w, v)| w[c] * cut(*v)).sum::<f64>();
                }
            }
        }
        let [fl, fr, rl, rr] = [0, 1, 2, 3].map(|i| means[RIM_AT + i]);
        means[RIM_AT..].copy_from_slice(&[0.25 * (fl + fr + rl + rr), 0.5 * (fl - fr), 0.5 * (rl - rr), 0.25 * (fl + fr - rl - rr)]);
        out.rows_mut(0, CHANNELS).copy_from_slice(&means);
        out
    }
}
