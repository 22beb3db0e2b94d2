//! What `nesam adapt` scores beside the filter in force: the literal Algorithm 1 and oracles.

use std::sync::Arc;

use nesam_adaptation::FilterConfig;
use nesam_evaluation::{
    ModelName, Resamples, Row, TrueSoil, Truth, Window, WindowPredictor, adapt_all, best_correction, predict_all, score,
};
use nesam_model::{Predictor, SoilField};

use super::AlsoArg;
use crate::failure::{Failure, OrFail};
use crate::progress::Progress;
use crate::sources::Drives;

/// Windows and model that every row shares.
pub(super) struct Scene<'a> {
    pub(super) predictor: &'a Arc<Predictor>,
    pub(super) drives: &'a Drives,
    pub(super) windows: &'a [Window<'a>],
    pub(super) truth: Truth,
    pub(super) resamples: &'a Resamples,
}

impl Scene<'_> {
    /// Scores one of them; `filter` tells how wide the prior is.
    pub(super) fn row(&self, also: AlsoArg, filter: &FilterConfig) -> Result<Row, Failure> {
        let predictor = || Arc::clone(self.predictor);
        let on = |soils| WindowPredictor::OnSoil { predictor: predictor(), soils: Arc::new(soils) };
        let (key, model) = match also {
            AlsoArg::Literal => ("literal", WindowPredictor::Adapted { predictor: predictor(), filtered: Arc::new(self.literal()?) }),
            AlsoArg::OracleSoil => {
                let soils = (0..self.drives.drives.len()).map(|d| Ok(self.true_soil(d)? as Arc<dyn SoilField>));
                ("oracle_soil", on(soils.collect::<Result<_, Failure>>()?))
            }
            AlsoArg::BestConstant => ("best_constant", on(self.best(false, filter)?)),
            AlsoArg::BestByClass => ("best_by_class", on(self.best(true, filter)?)),
        };
        let paths = predict_all(&[(ModelName::Nesam, model)], self.windows, &self.drives.maps, &|_| {}).or_failed()?;
        Ok(Row { key, score: score(&paths[0], self.windows, self.truth, self.resamples) })
    }

    fn literal(&self) -> Result<Vec<nesam_evaluation::DriveAdaptation>, Failure> {
        adapt_all(self.predictor, &self.drives.drives, &self.drives.maps, &FilterConfig::literal(), &|_| {}).or_input()
    }

    fn true_soil(&self, drive: usize) -> Result<Arc<TrueSoil>, Failure> {
        let trajectory = &self.drives.drives[drive];
        let place = trajectory.world.as_deref().zip(self.drives.maps[drive].as_ref());
        let (world, map) = place.ok_or_else(|| Failure::input(format!("drive {} has no world, so no true soil", trajectory.id)))?;
        TrueSoil::read(&self.drives.root.world_dir(world), map).or_input()
    }

    fn best(&self, by_class: bool, filter: &FilterConfig) -> Result<Vec<Arc<dyn SoilField>>, Failure> {
        let progress = Progress::start("drives fitted", self.drives.drives.len());
        let fit = |drive: usize| -> Result<Arc<dyn SoilField>, Failure> {
            let windows: Vec<Window<'_>> = self.windows.iter().filter(|w| w.drive == drive).copied().collect();
            let classes = if by_class { Some(self.true_soil(drive)?) } else { None };
            let map = self.drives.maps[drive].as_ref();
            let found = best_correction(self.predictor, &windows, map, self.truth, &filter.prior_sd, classes.as_ref()).or_failed()?;
            progress.set(drive + 1);
            Ok(Arc::new(found))
        };
        let found = (0..self.drives.drives.len()).map(fit).collect();
        progress.finish();
        found
    }
}
