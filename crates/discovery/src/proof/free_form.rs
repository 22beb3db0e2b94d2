//! What is left after the named effects, as a bounded wrench without a name ([`FreeForm`]).
//!
//! Its response is orthogonal to that of the named effects' parameters in the metric, so adding or removing it does not move their sizes; another soil of
//! each drive is profiled out as everywhere. The ridge is chosen by leaving each drive out.

use nalgebra::{DMatrix, DVector};
use nesam_physics::SoilCorrection;
use nesam_physics::effects::{Effect, FREE_FORM_AXES, FREE_FORM_FEATURES, FreeForm, ScheduledEffect};
use rayon::prelude::*;

use crate::claims::Case;
use crate::claims::fit::{Fit, parameter_columns};
use crate::observe::condense::{Condensed, Parts, difference};
use crate::proof::ridge;

/// Parameters of the term.
pub const PARAMETERS: usize = FREE_FORM_AXES * FREE_FORM_FEATURES;
/// Unit force as a share of the weight of the vehicle (chosen); the unit moment is the same at an arm of 1 m.
const UNIT_SHARE: f64 = 0.01;
/// What one unit of a feature is: constant, m/s, rad, slope.
const FEATURE_UNITS: [f64; FREE_FORM_FEATURES] = [1.0, 1.0, 0.2, 0.1];
/// Share of the samples of the drives that lie inside of the valid region on each side.
const INSIDE: f64 = 0.99;

/// The drives' scores in the coefficients of the term, after the named effects.
#[derive(Clone, Debug)]
pub struct Leftover {
    region: FreeForm,
    /// Unit of each coefficient. (parameters)
    units: Vec<f64>,
    /// Scores in the coefficients and, after them, in the parameters of the named effects.
    parts: Parts,
}

impl Leftover {
    /// Scores of a case after `fit`; without one, of everything by which the drives differ.
    pub fn of(case: &Case<'_>, fit: Option<&Fit>) -> Self {
        let vehicle = case.bench.vehicle;
        let region = region(case);
        let force = UNIT_SHARE * vehicle.mass_kg * vehicle.gravity_m_s2;
        let units: Vec<f64> = (0..PARAMETERS).map(|p| force / FEATURE_UNITS[p % FREE_FORM_FEATURES]).collect();
        let named = fit.map_or_else(Vec::new, Fit::effects);
        let metric = case.metric.believing_all();
        case.work.add(case.prepared.len());
        let drives = case
            .prepared
            .par_iter()
            .map(|prepared| {
                let with = |more: Option<Effect>| {
                    let effects: Vec<ScheduledEffect> = named.iter().copied().chain(more.map(Into::into)).collect();
                    prepared.drive.deviations(&case.bench, &effects, &SoilCorrection::NONE)
                };
                let rows = with(None);
                let mut columns: Vec<_> = (0..PARAMETERS)
                    .map(|p| {
                        let mut unit = region;
                        unit.wrench[p / FREE_FORM_FEATURES][p % FREE_FORM_FEATURES] = units[p];
                        difference(&rows, &with(Some(Effect::FreeForm(unit))), 1.0)
                    })
                    .collect();
                if let Some(fit) = fit {
                    columns.extend(parameter_columns(&case.bench, prepared, &fit.terms, &fit.values));
                }
                case.work.done();
                prepared.signatures.profiled(&metric, &rows, &columns)
            })
            .collect();
        Self { region, units, parts: Parts::of(drives) }
    }

    /// The term that the drives teach, but for the part of one of them where given, with the share of the distance that it explains on drives it was not fitted on; `None` where it explains nothing there.
    pub fn effect(&self, left_out: Option<usize>) -> Option<(Effect, f64)> {
        let kept: Vec<Condensed> = self.parts.without(left_out).map(|d| d.head(PARAMETERS)).collect();
        let keep = self.orthogonal(left_out);
        let found = ridge::fit(&kept.iter().collect::<Vec<_>>(), keep.as_ref())?;
        let mut effect = self.region;
        for (own, (c, unit)) in effect.wrench.as_flattened_mut().iter_mut().zip(found.coefficients.iter().zip(&self.units)) {
            *own = c * unit;
        }
        let effect = Effect::FreeForm(effect);
        let held: Vec<f64> = effect.parameters().iter().map(|p| p.value.clamp(p.range[0], p.range[1])).collect();
        Some((Effect::from_parameters(effect.id(), &held)?, found.gain))
    }

    /// Projection of coefficients onto those whose response is orthogonal to the named effects' parameters; `None` without such.
    fn orthogonal(&self, left_out: Option<usize>) -> Option<DMatrix<f64>> {
        let size = self.parts.without(None).next()?.score.len();
        let named = size - PARAMETERS;
        if named == 0 {
            return None;
        }
        let mut cross = DMatrix::zeros(PARAMETERS, named);
        for drive in self.parts.without(left_out) {
            cross += drive.information.view((0, PARAMETERS), (PARAMETERS, named));
        }
        let norms = DVector::from_iterator(named, cross.column_iter().map(|c| c.norm().max(1e-12)));
        for (mut column, norm) in cross.column_iter_mut().zip(norms.iter()) {
            column /= *norm;
        }
        let q = cross.qr().q();
        Some(DMatrix::identity(PARAMETERS, PARAMETERS) - &q * q.transpose())
    }
}

/// The valid region: what the drives did, without coefficients.
fn region(case: &Case<'_>) -> FreeForm {
    let samples: Vec<[f64; 4]> = case.prepared.iter().flat_map(|p| p.drive.conditions()).collect();
    let quantile = |of: &dyn Fn(&[f64; 4]) -> f64, share: f64| {
        let mut values: Vec<f64> = samples.iter().map(of).collect();
        values.sort_by(f64::total_cmp);
        nesam_evaluation::quantile_sorted(&values, share)
    };
    let low = quantile(&|s| s[0], 1.0 - INSIDE).clamp(-10.0, 29.0);
    FreeForm {
        speed_low_m_s: low,
        speed_high_m_s: quantile(&|s| s[0], INSIDE).clamp(low + 0.1, 30.0),
        angle_max_rad: quantile(&|s| s[1].abs(), INSIDE).clamp(0.0, 1.0),
        slope_max: quantile(&|s| s[2].abs().max(s[3].abs()), INSIDE).clamp(0.0, 1.0),
        ..FreeForm::default()
    }
}
