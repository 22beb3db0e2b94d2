//! What `nesam adapt` scores beside the filter in force: the literal Algorithm 1 and oracles.

use std::sync::Arc;

use nesam_adaptation::FilterConfig;
use nesam_evaluation::{
    ModelName, ModelPaths, PosePath, TrueSoil, Truth, Window, WindowPredictor, adapt_all, best_correction, predict_all,
};
use nesam_model::{Predictor, SoilField};
use nesam_physics::SoilCorrection;
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;

use super::AlsoArg;
use crate::failure::{Failure, OrFail};
use crate::progress::Progress;
use crate::sources::Drives;

/// Stretches of a drive that are predicted with what the others teach.
const STRETCHES: usize = 5;

/// Windows and model that every row shares.
pub(super) struct Scene<'a> {
    pub(super) predictor: &'a Arc<Predictor>,
    pub(super) drives: &'a Drives,
    pub(super) windows: &'a [Window<'a>],
    pub(super) truth: Truth,
    /// The simulator's soil of every drive; empty where no row asks for it.
    pub(super) true_soils: &'a [Arc<TrueSoil>],
}

/// The simulator's soil of every drive.
pub(super) fn read_true_soils(drives: &Drives) -> Result<Vec<Arc<TrueSoil>>, Failure> {
    let of = |(drive, map): (&Trajectory, &Option<Arc<WorldMap>>)| {
        let place = drive.world.as_deref().zip(map.as_ref());
        let (world, map) = place.ok_or_else(|| Failure::input(format!("drive {} has no world, so no true soil", drive.id)))?;
        TrueSoil::read(&drives.root.world_dir(world), map).or_input()
    };
    drives.drives.iter().zip(&drives.maps).map(of).collect()
}

impl Scene<'_> {
    /// What one of them predicts, by its key in the JSON; `filter` tells how wide the prior is.
    pub(super) fn paths(&self, also: AlsoArg, filter: &FilterConfig) -> Result<(&'static str, ModelPaths), Failure> {
        let predictor = || Arc::clone(self.predictor);
        let on = |soils| WindowPredictor::OnSoil { predictor: predictor(), soils: Arc::new(soils) };
        let (key, model) = match also {
            AlsoArg::ConstantElsewhere => return Ok(("constant_elsewhere", self.constant_elsewhere(filter)?)),
            AlsoArg::Literal => ("literal", WindowPredictor::Adapted { predictor: predictor(), filtered: Arc::new(self.literal()?) }),
            AlsoArg::OracleSoil => {
                let soils = self.true_soils.iter().map(|soil| Arc::clone(soil) as Arc<dyn SoilField>);
                ("oracle_soil", on(soils.collect::<Vec<_>>()))
            }
            AlsoArg::BestConstant => ("best_constant", on(self.best(false, filter)?)),
            AlsoArg::BestByClass => ("best_by_class", on(self.best(true, filter)?)),
        };
        let mut paths = predict_all(&[(ModelName::Nesam, model)], self.windows, &self.drives.maps, &|_| {}).or_failed()?;
        Ok((key, paths.remove(0)))
    }

    /// Each window predicted with the correction that other stretches of its drive ask for.
    fn constant_elsewhere(&self, filter: &FilterConfig) -> Result<ModelPaths, Failure> {
        let drives = self.drives.drives.len();
        let stretches = self.stretches();
        let within = |stretch: usize| self.windows.iter().zip(&stretches).enumerate().filter(move |(_, (_, s))| **s == stretch);
        let progress = Progress::start("corrections fitted", STRETCHES * drives);
        let mut placed: Vec<(usize, PosePath)> = Vec::with_capacity(self.windows.len());
        let mut parameters = 0;
        for stretch in 0..STRETCHES {
            let (places, held_back): (Vec<usize>, Vec<Window<'_>>) = within(stretch).map(|(place, (window, _))| (place, *window)).unzip();
            let elsewhere = |drive: usize| -> Result<Arc<dyn SoilField>, Failure> {
                let apart = |w: &&Window<'_>| held_back.iter().all(|h| h.drive != drive || h.start.abs_diff(w.start) >= w.horizon);
                let others: Vec<Window<'_>> = self.windows.iter().filter(|w| w.drive == drive).filter(apart).copied().collect();
                progress.set(stretch * drives + drive + 1);
                if others.is_empty() {
                    return Ok(Arc::new(SoilCorrection::NONE));
                }
                let map = self.drives.maps[drive].as_ref();
                Ok(Arc::new(best_correction(self.predictor, &others, map, self.truth, &filter.prior_sd, None).or_failed()?))
            };
            let soils = Arc::new((0..drives).map(elsewhere).collect::<Result<_, _>>()?);
            let model = WindowPredictor::OnSoil { predictor: Arc::clone(self.predictor), soils };
            for predicted in predict_all(&[(ModelName::Nesam, model)], &held_back, &self.drives.maps, &|_| {}).or_failed()? {
                parameters = predicted.parameters;
                placed.extend(places.iter().copied().zip(predicted.paths));
            }
        }
        progress.finish();
        placed.sort_by_key(|(place, _)| *place);
        Ok(ModelPaths { name: ModelName::Nesam, parameters, paths: placed.into_iter().map(|(_, path)| path).collect() })
    }

    /// Stretch of its drive that each window belongs to, by its rank there.
    fn stretches(&self) -> Vec<usize> {
        let mut counts = vec![0; self.drives.drives.len()];
        let mut count = |w: &Window<'_>| {
            counts[w.drive] += 1;
            counts[w.drive] - 1
        };
        let ranks: Vec<usize> = self.windows.iter().map(&mut count).collect();
        self.windows.iter().zip(ranks).map(|(w, rank)| rank * STRETCHES / counts[w.drive]).collect()
    }

    fn literal(&self) -> Result<Vec<nesam_evaluation::DriveAdaptation>, Failure> {
        adapt_all(self.predictor, &self.drives.drives, &self.drives.maps, &FilterConfig::literal(), &|_| {}).or_input()
    }

    fn best(&self, by_class: bool, filter: &FilterConfig) -> Result<Vec<Arc<dyn SoilField>>, Failure> {
        let progress = Progress::start("drives fitted", self.drives.drives.len());
        let fit = |drive: usize| -> Result<Arc<dyn SoilField>, Failure> {
            let windows: Vec<Window<'_>> = self.windows.iter().filter(|w| w.drive == drive).copied().collect();
            let classes = if by_class { self.true_soils.get(drive) } else { None };
            let map = self.drives.maps[drive].as_ref();
            let found = best_correction(self.predictor, &windows, map, self.truth, &filter.prior_sd, classes).or_failed()?;
            progress.set(drive + 1);
            Ok(Arc::new(found))
        };
        let found = (0..self.drives.drives.len()).map(fit).collect();
        progress.finish();
        found
    }
}
