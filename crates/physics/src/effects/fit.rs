//! Which effects a vehicle cannot have.

use std::collections::BTreeSet;

use super::{Effect, EffectTerms, PLACES_MAX, Phases, Scaling, ScheduledEffect};
use crate::command_path::longest_delay_s;
use crate::step::RigidBody;
use crate::vehicle::Vehicle;

/// Effects that act each at its own place, [`PLACES_MAX`] at once.
const LISTED: [&str; 3] = ["soil_drift", "soil_crust", "free_form"];

impl Vehicle {
    /// Checks that the vehicle of this card can have effects and no others, in each phase between their onsets, in steps of `dt_s` s.
    ///
    /// # Errors
    /// What is wrong, to follow the name of what holds the effects: no mass or no inertia is left, commands come later than they are followed, or
    /// an effect acts at more places than it can.
    pub fn check_effects(&self, effects: &[ScheduledEffect], dt_s: f64) -> Result<(), String> {
        let bare = Self { effects: EffectTerms::default(), ..self.clone() };
        let phases = Phases::of(effects, |begun| bare.with_effects(begun).at_fault(begun, dt_s));
        phases.all().flatten().next().map_or(Ok(()), |fault| Err(fault.clone()))
    }

    /// What is wrong with this vehicle, which has these effects.
    fn at_fault(&self, effects: &[Effect], dt_s: f64) -> Option<String> {
        if let Some(fault) = places_at_fault(effects) {
            return Some(fault);
        }
        let body = RigidBody::new(self);
        if body.mass_kg.is_nan() || body.mass_kg <= 0.0 {
            let by = those(effects, |terms| terms.force.added_mass_kg != 0.0);
            return Some(format!("leaves `{}` a mass of {} kg ({by})", self.name, body.mass_kg));
        }
        if !body.is_physical() {
            let by = those(effects, |terms| terms.force.added_mass_kg != 0.0 || terms.force.centre_shift_m != [0.0; 3]);
            return Some(format!("leaves `{}` an inertia about its centre of mass that is not positive ({by})", self.name));
        }
        let step_s = dt_s / (1.0 + self.effects.sensor.clock_drift);
        let (delay_s, longest_s) = (self.command_delay_s().into_iter().fold(0.0, f64::max), longest_delay_s(step_s));
        if delay_s > longest_s + 1e-9 {
            let by = those(effects, |terms| terms.actuator.delay_s != [0.0; 2]);
            let name = &self.name;
            return Some(format!(
                "makes the commands of `{name}` {delay_s} s late ({by}); at most {longest_s} s are followed in such steps"
            ));
        }
        None
    }
}

/// Of which effect there are more places than can act at once, to follow the name of what holds the effects.
pub fn places_at_fault(effects: &[Effect]) -> Option<String> {
    let places = |id: &str| effects.iter().filter(|e| e.id() == id).map(place_of).collect::<BTreeSet<_>>().len();
    LISTED
        .into_iter()
        .map(|id| (id, places(id)))
        .find(|(_, places)| *places > PLACES_MAX)
        .map(|(id, places)| format!("has `{id}` at {places} places; {PLACES_MAX} can act at once"))
}

/// Place of an effect: the bits of what scaling it holds.
fn place_of(effect: &Effect) -> Vec<u64> {
    let of = effect.quantities().iter().zip(effect.values());
    of.filter(|(quantity, _)| quantity.scaling == Scaling::Held).map(|(_, value)| value.to_bits()).collect()
}

/// Ids of the effects that alone bring such terms.
fn those(effects: &[Effect], brings: impl Fn(&EffectTerms) -> bool) -> String {
    let alone = |effect: &&Effect| {
        let mut terms = EffectTerms::default();
        effect.add_to(&mut terms);
        brings(&terms)
    };
    let ids: Vec<&str> = effects.iter().filter(alone).map(Effect::id).collect();
    if ids.is_empty() { "by its card alone".into() } else { format!("by `{}`", ids.join("`, `")) }
}
