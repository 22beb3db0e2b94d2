//! Physical effects that act in one session, on top of those of the bundle.

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_model::{Predictor, named_effect};
use nesam_physics::effects::ScheduledEffect;

use crate::error::EngineError;

/// Effects in one session at most.
const EFFECTS_MAX: usize = 16;
/// Parameters with a standard deviation at most: each costs every buffer of the soil filter one more rollout.
pub const UNCERTAIN_MAX: usize = 8;
/// Bytes of the text that says where they come from.
const SOURCE_BYTES_MAX: usize = 256;

/// A parameter of an applied effect.
#[derive(Clone, Debug, PartialEq)]
pub struct AppliedParameter {
    /// Name as in the catalogue.
    pub name: String,
    /// Value, in the unit of the catalogue.
    pub value: f64,
    /// Standard deviation of the value; 0 = taken as exact.
    pub sd: f64,
}

/// An effect that was applied.
#[derive(Clone, Debug, PartialEq)]
pub struct AppliedEffect {
    /// Id of the catalogue.
    pub id: String,
    /// All of its parameters.
    pub parameters: Vec<AppliedParameter>,
}

/// The effects of a session and where they come from; none by default.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AppliedEffects {
    /// For people: a bundle, a report, a name.
    pub source: String,
    /// In the order given, each with its parameters in the order of the catalogue.
    pub effects: Vec<AppliedEffect>,
}

/// Applied effects, ready to predict with.
pub(crate) struct Acting {
    applied: AppliedEffects,
    /// The bundle's predictor with the effects; shares its weights and its maps.
    predictor: Predictor,
    /// The same with one uncertain parameter one standard deviation off.
    shifted: Vec<Predictor>,
}

impl core::fmt::Debug for Acting {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        self.applied.fmt(f)
    }
}

impl Acting {
    /// Puts effects on a predictor; `None` when there are none.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the effect that the catalogue does not allow or that leaves the vehicle no body, or the limit that is passed.
    pub fn new(base: &Predictor, applied: &AppliedEffects) -> Result<Option<Arc<Self>>, EngineError> {
        if applied.effects.is_empty() {
            return Ok(None);
        }
        if applied.effects.len() > EFFECTS_MAX {
            return Err(EngineError::invalid("effects", format!("holds {}, at most {EFFECTS_MAX} are allowed", applied.effects.len())));
        }
        if applied.source.len() > SOURCE_BYTES_MAX {
            let reason = format!("has {} bytes, at most {SOURCE_BYTES_MAX} are allowed", applied.source.len());
            return Err(EngineError::invalid("source", reason));
        }
        let named: Vec<(ScheduledEffect, AppliedEffect)> =
            applied.effects.iter().enumerate().map(|(i, effect)| checked(i, effect)).collect::<Result<_, _>>()?;
        let effects: Vec<ScheduledEffect> = named.iter().map(|(effect, _)| *effect).collect();
        let in_order: Vec<AppliedEffect> = named.into_iter().map(|(_, effect)| effect).collect();
        let uncertain = in_order.iter().flat_map(|effect| &effect.parameters).filter(|p| p.sd > 0.0).count();
        if uncertain > UNCERTAIN_MAX {
            let reason = format!("have {uncertain} parameters with a standard deviation, at most {UNCERTAIN_MAX} are allowed");
            return Err(EngineError::invalid("effects", reason));
        }
        let with = |effects: &[ScheduledEffect]| {
            let predictor = base.with_effects(effects);
            let bundle = predictor.bundle();
            let checked = bundle.vehicle.check_effects(&bundle.effects, bundle.normalization.dt_s);
            checked.map_err(|reason| EngineError::invalid("effects", reason)).map(|()| predictor)
        };
        let mut shifted = Vec::new();
        for (i, effect) in in_order.iter().enumerate() {
            for uncertain in effect.parameters.iter().filter(|p| p.sd > 0.0) {
                let mut moved = effects.clone();
                moved[i] = one_off(i, effect, uncertain)?;
                shifted.push(with(&moved)?);
            }
        }
        let applied = AppliedEffects { source: applied.source.clone(), effects: in_order };
        Ok(Some(Arc::new(Self { applied, predictor: with(&effects)?, shifted })))
    }

    /// The effects.
    pub fn applied(&self) -> &AppliedEffects {
        &self.applied
    }

    /// The predictor of the vehicle with them.
    pub fn predictor(&self) -> &Predictor {
        &self.predictor
    }

    /// The same with one uncertain parameter one standard deviation off.
    pub fn shifted(&self) -> &[Predictor] {
        &self.shifted
    }
}

fn by_name(effect: &AppliedEffect) -> BTreeMap<String, f64> {
    effect.parameters.iter().map(|p| (p.name.clone(), p.value)).collect()
}

/// The effect of the catalogue, and what was given in the order of its parameters.
fn checked(i: usize, effect: &AppliedEffect) -> Result<(ScheduledEffect, AppliedEffect), EngineError> {
    let refused = |reason: String| EngineError::invalid(format!("effects[{i}]"), reason);
    let values = by_name(effect);
    if values.len() != effect.parameters.len() {
        return Err(refused(format!("gives `{}` a parameter twice", effect.id)));
    }
    let named = named_effect(&effect.id, &values).map_err(refused)?;
    if let Some(p) = effect.parameters.iter().find(|p| !p.sd.is_finite() || p.sd < 0.0) {
        return Err(refused(format!("gives `{}` {} with sd = {}; it is 0 or more", effect.id, p.name, p.sd)));
    }
    let of_name = |name: &str| effect.parameters.iter().find(|p| p.name == name).cloned();
    let parameters = named.effect.parameters().iter().filter_map(|p| of_name(p.name)).collect();
    Ok((named, AppliedEffect { id: effect.id.clone(), parameters }))
}

/// The effect with one parameter one standard deviation up, or down where up is out of range.
fn one_off(i: usize, effect: &AppliedEffect, uncertain: &AppliedParameter) -> Result<ScheduledEffect, EngineError> {
    let moved = |sd: f64| {
        let mut values = by_name(effect);
        values.insert(uncertain.name.clone(), uncertain.value + sd);
        named_effect(&effect.id, &values)
    };
    moved(uncertain.sd).or_else(|_| moved(-uncertain.sd)).map_err(|_| {
        let reason = format!("gives `{}` {} with sd = {}, wider than its range", effect.id, uncertain.name, uncertain.sd);
        EngineError::invalid(format!("effects[{i}]"), reason)
    })
}
