//! Rollouts of all candidates of a query.
//!
//! Blocks of thirty-two samples, of sixteen where there are few, go through the horizon on their own, so that what a block remembers stays near the processor. A
//! block that meets terrain which is not encoded yet stands aside; when all have finished or stand aside, what they miss is encoded together, in parallel, and they
//! go on. Which block waits for what changes nothing in the results: a node of the terrain is a function of its pose alone.

use std::sync::{Arc, Mutex, PoisonError};

use nesam_physics::{Control, SOIL_DIM, STATE_DIM, Soil, SoilCorrection, WHEELS};
use rayon::prelude::*;

use super::block::Block;
use super::parts::PartClocks;
use super::risk::RiskRow;
use super::validate::{validate, validate_extras};
use super::{LogClock, OFF_GROUND_M, Predictor, Sample, control, pose, raw_soil, under};
use crate::ModelError;
use crate::fused::{BlockCache, LANES, Prefix};
use crate::ground::GroundSource;
use crate::interruption::Interruption;
use crate::precision::Precision;
use crate::rollout::{Due, RiskOutputs, Rollout, RolloutExtras, RolloutQuery, Variant, flag, is_raised};
use crate::soil_coordinates::from_raw;
use crate::soil_field::SoilField;
use crate::terrain_tokens::{Node, TerrainToken, TerrainTokens};

/// Everything of a query that is the same for all samples.
pub(super) struct Scene<'a> {
    pub(super) query: &'a RolloutQuery<'a>,
    pub(super) soil: &'a dyn SoilField,
    pub(super) ground: GroundSource<'a>,
    pub(super) prefix: Prefix,
    pub(super) datum_m: f64,
    pub(super) variant: Variant,
    pub(super) risk: bool,
    pub(super) unrounded: bool,
    pub(super) interruption: Interruption<'a>,
    pub(super) due: Option<Due<'a>>,
    pub(super) clock: LogClock,
    pub(super) tokens: Option<&'a TerrainTokens>,
    pub(super) clocks: Option<&'a PartClocks>,
}

impl Scene<'_> {
    /// Command of a row in step `k`: every group of samples has the same.
    pub(super) fn control(&self, row: usize, k: usize) -> Control<f64> {
        control(self.query, row % self.query.samples, k)
    }

    /// Whether nothing more is to be computed of a block that begins with this row, once nothing is more urgent: nobody waits, or the answer is due and has enough without it.
    pub(super) fn is_over(&self, first: usize) -> bool {
        self.interruption.ends() || self.due.is_some_and(|due| first >= due.least && is_raised(Some(due.flag)))
    }
}

/// Caches of blocks of 16 H samples, used again by the next block and the next query: as many as threads work on blocks of a rollout and of one that waits for it.
#[derive(Debug, Default)]
pub(super) struct Caches<const H: usize>(Mutex<Vec<BlockCache<H>>>);

impl<const H: usize> Caches<H> {
    /// A cache without steps and with room for `horizon`.
    pub(super) fn take(&self, horizon: usize, remembers: bool) -> BlockCache<H> {
        let free = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut cache = free.unwrap_or_default();
        cache.restart(horizon, remembers);
        cache
    }

    /// Gives one back. More than threads can use at once are there only while blocks wait for terrain.
    pub(super) fn give(&self, cache: BlockCache<H>) {
        let mut free = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if free.len() < 2 * rayon::current_num_threads() {
            free.push(cache);
        }
    }
}

/// Caches for blocks of two vectors and of one.
#[derive(Debug, Default)]
pub(super) struct BlockCaches {
    wide: Caches<2>,
    narrow: Caches<1>,
}

/// A correction for each group of `samples` rows.
#[derive(Debug)]
struct SoilPerGroup<'a> {
    soils: &'a [SoilCorrection],
    samples: usize,
}

impl SoilField for SoilPerGroup<'_> {
    fn soil(&self, row: usize, _position_m: [f64; 2], prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        self.soils[row / self.samples].apply(prior)
    }
}

impl Predictor {
    /// The same with what-if soils and, where they are asked for, risk outputs. States do not depend on whether risk is asked for, and a what-if soil
    /// that equals the query's correction gives the rollout of the query, both bit for bit.
    ///
    /// # Errors
    /// As [`Predictor::rollout`]; also naming `soils` when a correction is not finite, and `risk` when the form has no soil; `ModelError::Abandoned` when it was
    /// given up.
    pub fn rollout_with(&self, query: &RolloutQuery<'_>, extras: &RolloutExtras<'_>) -> Result<(Rollout, Option<RiskOutputs>), ModelError> {
        self.rollout_timed(query, extras, None)
    }

    /// The same, with clocks for a bench.
    pub(super) fn rollout_timed(
        &self,
        query: &RolloutQuery<'_>,
        extras: &RolloutExtras<'_>,
        clocks: Option<&PartClocks>,
    ) -> Result<(Rollout, Option<RiskOutputs>), ModelError> {
        validate(query)?;
        validate_extras(extras)?;
        let variant = self.form_of(query);
        if extras.risk && !variant.has_soil() {
            return Err(ModelError::Query { field: "risk", reason: format!("a model of the form `{}` has no soil", variant.as_str()) });
        }
        let tokens = query.map.map(|map| self.tokens_of(map));
        let clock = LogClock { start_s: query.start_time_s, dt_s: self.bundle.normalization.dt_s };
        let (history, start_state) = self.true_motion(query.history, &query.start, clock);
        let history = history.as_ref();
        let ground = GroundSource::new(query.map.map(Arc::as_ref), self.physics.at(clock.start_s), &start_state);
        let what_if = SoilPerGroup { soils: extras.soils, samples: query.samples };
        let scene = Scene {
            query,
            soil: if extras.soils.is_empty() { extras.field.unwrap_or(&query.soil_correction) } else { &what_if },
            prefix: self.prefix(variant, history, &ground, tokens.as_deref(), clock),
            ground,
            datum_m: start_state.position_m[2],
            variant,
            risk: extras.risk,
            unrounded: extras.unrounded,
            interruption: extras.interruption,
            due: extras.due.filter(|_| extras.soils.is_empty()),
            clock,
            tokens: tokens.as_deref(),
            clocks,
        };
        let rows = extras.soils.len().max(1) * query.samples;
        let off_ground = scene.ground.clearance_m(self.physics.at(clock.start_s), &start_state).abs() > OFF_GROUND_M;
        let of_start = if off_ground { flag::START_OFF_GROUND } else { 0 } | if query.map.is_none() { flag::NO_MAP } else { 0 };
        // Without a history the actuators begin as a row's own first command says, so rows stay independent.
        let start = |row: usize| Sample {
            state: start_state,
            previous: history.last().map(|step| step.state),
            actuators: self.actuators(history, &start_state, &scene.control(row, 0), clock),
            flags: of_start,
        };
        let shared = start(0);
        let under_start = self.terrain(scene.tokens, &[pose(&start_state)])[0];
        let mut samples: Vec<Sample> = match history.is_empty() {
            true => (0..rows).map(start).collect(),
            false => self.observed_samples(&scene, shared, &under_start, self.observed_share(history, clock), rows),
        };
        let mut rollout = Rollout {
            states: vec![0.0; rows * query.horizon * STATE_DIM],
            position_m: Vec::new(),
            sinkage_m: vec![0.0; rows * query.horizon * WHEELS],
            flags: Vec::new(),
            soil: self.soil_at(under(scene.soil, 0, &shared, &under_start), clock.before(0)),
            samples: rows,
            horizon: query.horizon,
        };
        // Blocks of two vectors read weights half as often. In bf16 these are half as large already, and what two vectors remember costs more than that saves; few
        // candidates keep all threads busy in smaller blocks.
        let wide = self.precision() == Precision::F32 && rows > LANES * rayon::current_num_threads();
        let risk = match wide {
            true => self.roll_blocks(&scene, &self.caches.wide, &mut samples, &mut rollout),
            false => self.roll_blocks(&scene, &self.caches.narrow, &mut samples, &mut rollout),
        };
        if scene.interruption.is_abandoned() {
            return Err(ModelError::Abandoned);
        }
        rollout.flags = samples[..rollout.samples].iter().map(|s| s.flags).collect();
        Ok((rollout, risk))
    }

    /// Every row at the start after a history, which has also told what the speed control makes up for on the soil of the row.
    fn observed_samples(
        &self,
        scene: &Scene<'_>,
        shared: Sample,
        under_start: &TerrainToken,
        observed_share: f64,
        rows: usize,
    ) -> Vec<Sample> {
        let now = |soil: [f64; SOIL_DIM]| Soil::from_array(self.soil_at(soil, scene.clock.before(0)));
        let prior = from_raw(&raw_soil(under_start));
        let ([x_m, y_m, _], nominal) = (shared.state.position_m, now(prior));
        let mut known: Option<(Soil<f64>, Sample)> = None;
        let of_row = |row: usize| {
            let soil = now(scene.soil.soil(row, [x_m, y_m], &prior));
            if let Some((before, sample)) = &known
                && *before == soil
            {
                return *sample;
            }
            let mut sample = shared;
            sample.actuators.speed_error_integral_m += self.made_up_for_m(&nominal, &soil, &shared.state, observed_share, scene.clock);
            known = Some((soil, sample));
            sample
        };
        (0..rows).map(of_row).collect()
    }

    /// Takes all samples through the horizon, 16 H at a time.
    fn roll_blocks<const H: usize>(
        &self,
        scene: &Scene<'_>,
        caches: &Caches<H>,
        samples: &mut [Sample],
        rollout: &mut Rollout,
    ) -> Option<RiskOutputs> {
        let horizon = rollout.horizon;
        let size = H * LANES;
        let mut blocks: Vec<Block<'_, H>> = samples
            .chunks_mut(size)
            .zip(rollout.states.chunks_mut(size * horizon * STATE_DIM))
            .zip(rollout.sinkage_m.chunks_mut(size * horizon * WHEELS))
            .enumerate()
            .map(|(index, ((samples, states), sinkage_m))| Block {
                first: index * size,
                done: 0,
                risk: vec![RiskRow::default(); if scene.risk { samples.len() * horizon } else { 0 }],
                position_m: vec![[0.0; 3]; if scene.unrounded { samples.len() * horizon } else { 0 }],
                samples,
                states,
                sinkage_m,
                cache: None,
                missing: Vec::new(),
            })
            .collect();
        // Where fewer samples are of use the first ones come first, as many blocks at once as there are threads.
        let at_once = if scene.due.is_some() { rayon::current_num_threads() } else { blocks.len() };
        let mut done = 0;
        for together in blocks.chunks_mut(at_once) {
            self.advance_blocks(scene, caches, together);
            let whole = together.iter().take_while(|block| block.done == horizon);
            done += whole.map(|block| block.samples.len()).sum::<usize>();
            if together.iter().any(|block| block.done < horizon) {
                break;
            }
        }
        let risk = scene.risk.then(|| {
            let mut risk = RiskOutputs::zero(done * horizon);
            for block in blocks.iter().take_while(|block| block.first < done) {
                for (row, values) in block.risk.iter().enumerate() {
                    risk.put(block.first * horizon + row, values);
                }
            }
            risk
        });
        rollout.position_m = blocks.into_iter().flat_map(|block| block.position_m).collect();
        rollout.position_m.truncate(done * horizon);
        rollout.states.truncate(done * horizon * STATE_DIM);
        rollout.sinkage_m.truncate(done * horizon * WHEELS);
        rollout.samples = done;
        risk
    }

    /// Takes blocks to the end of the horizon, or to where they are given up; what they lack of the terrain is encoded for all of them at once.
    fn advance_blocks<const H: usize>(&self, scene: &Scene<'_>, caches: &Caches<H>, blocks: &mut [Block<'_, H>]) {
        loop {
            let behind = blocks.par_iter_mut().filter(|block| block.done < scene.query.horizon);
            behind.for_each(|block| self.advance_block(scene, caches, block));
            let aside = blocks.iter_mut().filter(|block| !scene.is_over(block.first));
            let missing: Vec<Node> = aside.flat_map(|block| block.missing.drain(..)).collect();
            match scene.tokens {
                Some(tokens) if !missing.is_empty() => tokens.encode_unless(&self.projection, missing, || scene.interruption.ends()),
                _ => return,
            }
        }
    }
}
