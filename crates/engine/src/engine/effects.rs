//! Effects on sessions, and what their watches tell.

use nesam_physics::SecondCommand;
use nesam_physics::effects::Effect;

use super::Engine;
use crate::command::{Event, Reply};
use crate::error::EngineError;
use crate::session::{Acting, Alarm, AppliedEffects};

impl Engine {
    /// Puts effects on a session, in place of those that were applied before. The same again change their source alone.
    pub(super) fn set_effects(&mut self, id: &str, effects: &AppliedEffects) -> Result<Reply, EngineError> {
        let filter = self.filter_on(self.session(id)?.map())?.clone();
        let acting = Acting::new(&self.predictor, effects)?;
        self.check_effects_fit(effects)?;
        let session = self.sessions.get_mut(id).ok_or_else(|| EngineError::UnknownSession { session: id.into() })?;
        let before = session.applied();
        session.act(acting, filter);
        let after = session.applied();
        if after != before {
            let (vehicle, soil, told) = (session.vehicle().to_string(), Box::new(*session.soil()), session.take_told());
            self.emit_alarms(id, &vehicle, told);
            self.emit(Event::EffectsChanged { session: id.into(), vehicle: vehicle.clone() });
            if after.effects != before.effects {
                let provenance = self.provenance(self.session(id)?).into();
                self.emit(Event::SoilChanged { session: id.into(), vehicle, soil, provenance });
            }
        }
        Ok(Reply::Session(Box::new(self.view(self.session(id)?))))
    }

    /// Refuses effects of skid-steer drives on another vehicle, where they change nothing. Those that a session brings with its image stay.
    fn check_effects_fit(&self, effects: &AppliedEffects) -> Result<(), EngineError> {
        let vehicle = self.vehicle();
        if vehicle.second == SecondCommand::YawRateRadS {
            return Ok(());
        }
        match effects.effects.iter().position(|effect| Effect::example(&effect.id).is_some_and(|effect| effect.is_of_skid_steer())) {
            None => Ok(()),
            Some(i) => {
                let reason = format!("is `{}`, which changes nothing on `{}`: it does not skid-steer", effects.effects[i].id, vehicle.name);
                Err(EngineError::invalid(format!("effects[{i}]"), reason))
            }
        }
    }

    /// Tells what a watch has raised or cleared.
    pub(super) fn emit_alarms(&mut self, session: &str, vehicle: &str, told: Vec<Alarm>) {
        for alarm in told {
            let (session, vehicle, alarm) = (session.into(), vehicle.into(), Box::new(alarm));
            self.emit(Event::AlarmChanged { session, vehicle, alarm, carried: false });
        }
    }
}
