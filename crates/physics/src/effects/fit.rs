//! Which effects a vehicle cannot have.

use super::{Effect, EffectTerms, Phases, ScheduledEffect};
use crate::command_path::longest_delay_s;
use crate::step::RigidBody;
use crate::vehicle::Vehicle;

impl Vehicle {
    /// Checks that the vehicle of this card can have effects and no others, in each phase between their onsets, in steps of `dt_s` s.
    ///
    /// # Errors
    /// What is wrong, to follow the name of what holds the effects: no mass or no inertia is left, or commands come later than they are followed.
    pub fn check_effects(&self, effects: &[ScheduledEffect], dt_s: f64) -> Result<(), String> {
        let bare = Self { effects: EffectTerms::default(), ..self.clone() };
        let phases = Phases::of(effects, |begun| bare.with_effects(begun).at_fault(begun, dt_s));
        phases.all().flatten().next().map_or(Ok(()), |fault| Err(fault.clone()))
    }

    /// What is wrong with this vehicle, which has these effects.
    fn at_fault(&self, effects: &[Effect], dt_s: f64) -> Option<String> {
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
