//! Rolling a session forward from its newest measured step to the instant that a planner asks from.

use std::borrow::Cow;

use nesam_model::{RiskOutputs, Rollout};
use nesam_physics::{Control, STATE_DIM, Vehicle, VehicleState, WHEELS};

use crate::error::EngineError;
use crate::limits::{Limits, outside_card};

/// Commands on their way to the vehicle that one query may name.
pub const SENT_COMMANDS_MAX: usize = 256;

/// A command and the instant from which the vehicle applies it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SentCommand {
    /// ns of the vehicle's clock.
    pub stamp_ns: i64,
    /// The command.
    pub command: Control<f64>,
}

/// The instant from which a planner asks, and what the vehicle was told to do until then.
#[derive(Clone, Debug, PartialEq)]
pub struct StartInstant {
    /// ns of the vehicle's clock.
    pub stamp_ns: i64,
    /// By ascending stamp.
    pub sent: Vec<SentCommand>,
}

impl StartInstant {
    /// Checks what needs no session.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the entry of `sent` at fault.
    pub fn check(&self, vehicle: &Vehicle) -> Result<(), EngineError> {
        if self.sent.len() > SENT_COMMANDS_MAX {
            return Err(EngineError::invalid("sent", format!("has {} commands, allowed are up to {SENT_COMMANDS_MAX}", self.sent.len())));
        }
        for (i, SentCommand { stamp_ns, command }) in self.sent.iter().enumerate() {
            if i > 0 && *stamp_ns <= self.sent[i - 1].stamp_ns {
                let reason =
                    format!("is {stamp_ns}, not after the {} before it; give the commands by ascending stamp", self.sent[i - 1].stamp_ns);
                return Err(EngineError::invalid(format!("sent[{i}].stamp_ns"), reason));
            }
            for (entry, value) in [("speed_m_s", command.speed_m_s), ("second", command.second)] {
                if !value.is_finite() {
                    return Err(EngineError::invalid(
                        format!("sent[{i}].command.{entry}"),
                        format!("is {value}, a finite number is needed"),
                    ));
                }
            }
            if let Some((entry, reason)) = outside_card(vehicle, command) {
                return Err(EngineError::invalid(format!("sent[{i}].command.{entry}"), reason));
            }
        }
        Ok(())
    }
}

/// The newest measured step of a session.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Newest {
    /// Its stamp, ns of the vehicle's clock.
    pub stamp_ns: i64,
    /// Command from then on, as far as the vehicle has reported.
    pub command: Control<f64>,
}

/// The steps between the newest measured step and the start of a query, one command for each, or the measured steps that came after it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct RollForward {
    commands: Vec<[f32; 2]>,
    back: usize,
}

impl RollForward {
    /// Rounds the instant to the grid of steps and looks up the command that was in effect at the middle of each step. What was sent before the
    /// newest step is part of what the vehicle has reported with it. An instant before the newest of `measured` steps, which came while the question waited, is
    /// answered from the step that was measured then.
    ///
    /// # Errors
    /// Naming `start_stamp_ns`: `EngineError::Invalid` when the instant lies before the history, `EngineError::NotReady` when it lies so far after the newest step
    /// that the steps rolled forward and the horizon exceed the positions of the model: what was measured is too old for it.
    pub fn plan(
        instant: &StartInstant,
        newest: Newest,
        step_ns: i64,
        horizon: usize,
        measured: usize,
        limits: &Limits,
    ) -> Result<Self, EngineError> {
        let ahead_ns = i128::from(instant.stamp_ns) - i128::from(newest.stamp_ns);
        let step = i128::from(step_ns);
        let steps = (2 * ahead_ns + step).div_euclid(2 * step);
        let seconds = ahead_ns as f64 * 1e-9;
        if steps < 0 {
            let Some(back) = usize::try_from(-steps).ok().filter(|back| *back < measured) else {
                let reason =
                    format!("lies {} s before the newest measured step, and the session holds {measured} steps without a gap", -seconds);
                return Err(EngineError::invalid("start_stamp_ns", reason));
            };
            return Ok(Self { commands: Vec::new(), back });
        }
        let steps_max = limits.steps_max().saturating_sub(horizon);
        let Some(steps) = usize::try_from(steps).ok().filter(|steps| *steps <= steps_max) else {
            let reason = format!(
                "lies {seconds} s = {steps} steps after the newest measured step; with horizon {horizon} at most {steps_max} are allowed: send newer \
                 measurements or ask for a shorter horizon"
            );
            return Err(EngineError::NotReady { field: "start_stamp_ns".into(), reason });
        };
        let command_in = |step: usize| {
            let middle_ns = i128::from(newest.stamp_ns) + (step as i128) * i128::from(step_ns) + i128::from(step_ns) / 2;
            let since = instant.sent.iter().filter(|sent| sent.stamp_ns > newest.stamp_ns);
            let in_effect = since.take_while(|sent| i128::from(sent.stamp_ns) <= middle_ns).last();
            let command = in_effect.map_or(newest.command, |sent| sent.command);
            command.packed()
        };
        Ok(Self { commands: (0..steps).map(command_in).collect(), back: 0 })
    }

    /// Measured steps after the start, which are left aside.
    pub fn back(&self) -> usize {
        self.back
    }

    /// Number of steps.
    pub fn steps(&self) -> usize {
        self.commands.len()
    }

    /// Puts the commands of the steps before those of every sample of row-major (samples, horizon, 2).
    pub fn prepend<'a>(&self, controls: &'a [f32], horizon: usize) -> Cow<'a, [f32]> {
        let before = self.commands.as_flattened();
        if before.is_empty() {
            return Cow::Borrowed(controls);
        }
        controls.chunks_exact(2 * horizon).flat_map(|sample| before.iter().chain(sample)).copied().collect()
    }

    /// Rows of `width` numbers after the steps rolled forward, of samples of `horizon` rows.
    fn tail(&self, values: &[f32], horizon: usize, width: usize) -> Vec<f32> {
        values.chunks_exact(horizon * width).flat_map(|sample| &sample[self.steps() * width..]).copied().collect()
    }

    /// Takes the steps off risk outputs of `horizon` steps.
    pub fn split_risk(&self, risk: RiskOutputs, horizon: usize) -> RiskOutputs {
        let of = |values: &[f32], width: usize| self.tail(values, horizon, width);
        RiskOutputs {
            wheel_load_n: of(&risk.wheel_load_n, WHEELS),
            wheel_slip: of(&risk.wheel_slip, WHEELS),
            load_transfer_ratio: of(&risk.load_transfer_ratio, 1),
            traction_reserve: of(&risk.traction_reserve, 1),
        }
    }

    /// Takes the steps off a rollout again, and gives the state after them: every sample on the same soil has the same, since it had the same commands. Of several soils it is
    /// that of the first.
    pub fn split(&self, rollout: Rollout) -> (Option<VehicleState<f64>>, Rollout) {
        let Some(last) = self.steps().checked_sub(1) else { return (None, rollout) };
        let start = rollout.state_f64(0, last);
        let (states, sinkage_m) =
            (self.tail(&rollout.states, rollout.horizon, STATE_DIM), self.tail(&rollout.sinkage_m, rollout.horizon, WHEELS));
        (Some(start), Rollout { states, position_m: Vec::new(), sinkage_m, horizon: rollout.horizon - self.steps(), ..rollout })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_NS: i64 = 100_000_000;
    const NEWEST: Newest = Newest { stamp_ns: 5 * STEP_NS, command: Control { speed_m_s: 9.0, second: 0.0 } };

    fn sent(stamp_ns: i64, speed_m_s: f64) -> SentCommand {
        SentCommand { stamp_ns, command: Control { speed_m_s, second: 0.5 } }
    }

    fn plan(stamp_ns: i64, sent: Vec<SentCommand>, horizon: usize) -> Result<RollForward, EngineError> {
        RollForward::plan(&StartInstant { stamp_ns, sent }, NEWEST, STEP_NS, horizon, 3, &Limits::default())
    }

    #[test]
    fn analytic_instants_are_rounded_to_the_nearest_step() {
        for (offset_ns, steps) in
            [(0, 0), (-STEP_NS / 2, 0), (STEP_NS / 2 - 1, 0), (STEP_NS / 2, 1), (3 * STEP_NS + 7, 3), (22 * STEP_NS, 22)]
        {
            assert_eq!(plan(NEWEST.stamp_ns + offset_ns, vec![], 10).unwrap().steps(), steps, "{offset_ns}");
        }
        // What was measured after the instant is left aside, as long as a step before it is held.
        for (offset_ns, back) in [(-STEP_NS / 2 - 1, 1), (-2 * STEP_NS, 2), (-2 * STEP_NS - STEP_NS / 2, 2)] {
            let start = plan(NEWEST.stamp_ns + offset_ns, vec![sent(0, 1.0)], 32).unwrap();
            assert_eq!((start.back(), start.steps()), (back, 0), "{offset_ns}");
        }
        let refused = |stamp_ns: i64| plan(stamp_ns, vec![], 10).unwrap_err();
        for stamp_ns in [NEWEST.stamp_ns - 3 * STEP_NS, i64::MIN] {
            assert!(matches!(refused(stamp_ns), EngineError::Invalid { field, .. } if field == "start_stamp_ns"), "{stamp_ns}");
        }
        // What is known is too old for it.
        for stamp_ns in [NEWEST.stamp_ns + 23 * STEP_NS, i64::MAX] {
            assert!(matches!(refused(stamp_ns), EngineError::NotReady { field, .. } if field == "start_stamp_ns"), "{stamp_ns}");
        }
        assert!(plan(NEWEST.stamp_ns + STEP_NS, vec![], 32).is_err() && plan(NEWEST.stamp_ns, vec![], 32).is_ok());
    }

    #[test]
    fn analytic_the_command_at_the_middle_of_a_step_counts() {
        // Steps have their middles at 5.5, 6.5, 7.5 and 8.5 steps.
        let late = sent(6 * STEP_NS + STEP_NS / 2, 1.0);
        let forward = plan(9 * STEP_NS, vec![late, sent(8 * STEP_NS, 2.0), sent(90 * STEP_NS, 3.0)], 4).unwrap();
        assert_eq!(forward.commands, [[9.0, 0.0], [1.0, 0.5], [1.0, 0.5], [2.0, 0.5]]);
        let missed = plan(6 * STEP_NS, vec![sent(5 * STEP_NS + STEP_NS / 2 + 1, 1.0)], 4).unwrap();
        assert_eq!(missed.commands, [[9.0, 0.0]]);
        let reported = plan(6 * STEP_NS, vec![sent(-STEP_NS, 1.0), sent(5 * STEP_NS, 2.0)], 4).unwrap();
        assert_eq!(reported.commands, [[9.0, 0.0]]);
    }

    #[test]
    fn analytic_split_undoes_prepend() {
        let forward = RollForward { commands: vec![[1.0, 2.0], [3.0, 4.0]], back: 0 };
        assert_eq!(*forward.prepend(&[5.0, 6.0, 7.0, 8.0], 1), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1.0, 2.0, 3.0, 4.0, 7.0, 8.0]);
        let (samples, horizon) = (2, 3);
        let count = |width: usize| (0..samples * horizon * width).map(|v| v as f32).collect::<Vec<_>>();
        let rollout = Rollout { states: count(STATE_DIM), sinkage_m: count(WHEELS), samples, horizon, ..Default::default() };
        let (start, tail) = forward.split(rollout.clone());
        assert_eq!(start.unwrap().to_array()[0], 12.0);
        assert_eq!(
            (tail.horizon, tail.states.len(), tail.sinkage_m.as_slice()),
            (1, 24, &[8.0, 9.0, 10.0, 11.0, 20.0, 21.0, 22.0, 23.0][..])
        );
        assert_eq!(tail.state(1, 0).to_array()[0], 60.0);
        assert_eq!(RollForward::default().split(rollout.clone()), (None, rollout));
    }
}
