//! The drive line of a skid-steer base, told by its wheel speeds over time.
//!
//! Rims that are servoed turn as they are told, whatever the ground does, so measured wheel speeds show the drive line alone: what it makes of the commands is run freely
//! from the first sample of each drive and held against them. Ramps, limits, delays and lags differ in the course of a step, of which the means of a segment keep little.
//! Effects are chosen one after the other, all sized together each time, and doubted again beside what was found after them. What is found stands before the ground
//! or a force is asked for, which no longer have to make up for it.

mod proof;
mod rims;
mod search;
mod sized;
mod spread;
mod turn;

use nesam_physics::effects::ScheduledEffect;
use nesam_physics::{SecondCommand, Vehicle, WHEELS};
use nesam_trajectories::Trajectory;

use crate::candidates::Candidate;
use crate::claims::Finding;
use crate::judgement::{Judgement, Verdict, together};
use crate::reference::DRIVES_MIN;
use crate::work::Work;
use rims::Rims;

const EFFICIENCY: &str = "turn_efficiency";

/// What wheel speeds tell.
#[derive(Clone, Debug, Default)]
pub(crate) struct DriveLine {
    /// What was found, none of it refused.
    pub findings: Vec<Finding>,
    /// The found effects.
    pub effects: Vec<ScheduledEffect>,
    /// The same as one step without each drive gives them.
    without: Vec<Vec<ScheduledEffect>>,
}

impl DriveLine {
    /// From drives of a vehicle that [tell](tells) it. `family` begins at this place of the catalogue; effects in `without` are not considered.
    pub fn told_by(
        vehicle: &Vehicle,
        drives: &[Trajectory],
        (family, first): (&[Candidate], usize),
        without: &[String],
        work: Work<'_>,
    ) -> Self {
        let considered = |c: &Candidate| !without.iter().any(|id| id == c.id());
        let rims = Rims::of(vehicle, drives, family.iter().copied().filter(|c| considered(c) && c.id() != EFFICIENCY).collect(), work);
        let place = |candidate: Candidate| first + family.iter().position(|c| *c == candidate).expect("it is of the family; this is a bug");
        let (settled, mut doubts) = rims.settled(rims.chosen());
        let (chosen, spread) = rims.sure(settled);
        if doubts.len() != chosen.terms.len() {
            doubts = (0..chosen.terms.len()).map(|i| rims.doubt(&chosen, i)).collect();
        }
        let scheduled = |values: &[f64]| rims.effects(&chosen.terms, values).into_iter().map(ScheduledEffect::from).collect::<Vec<_>>();
        let mut found = Self {
            findings: (0..chosen.terms.len()).map(|i| rims.finding(&chosen, i, spread.half_95[i], &doubts[i], place)).collect(),
            effects: scheduled(&chosen.values),
            without: spread.without.iter().map(|values| scheduled(values)).collect(),
        };
        // How much the ground lets a base turn is no fault of its drive line: alone it is not told.
        let turning = family.iter().copied().find(|c| c.id() == EFFICIENCY && considered(c) && !found.is_empty());
        if let Some(turning) = turning.and_then(|c| rims.turn_efficiency(&chosen, drives, c, place(c))) {
            found.effects.push(turning.effect(turning.factor));
            found.without.iter_mut().zip(&turning.without).for_each(|(effects, factor)| effects.push(turning.effect(*factor)));
            found.findings.push(turning.finding);
        }
        found
    }

    /// The effects without a drive.
    pub fn effects_without(&self, drive: usize) -> Vec<ScheduledEffect> {
        self.without.get(drive).unwrap_or(&self.effects).clone()
    }

    /// Hypotheses of the effects.
    pub fn hypotheses(&self) -> Vec<usize> {
        self.findings.iter().map(|f| f.hypothesis).collect()
    }

    /// What was found, in words.
    pub fn named(&self) -> String {
        let named: Vec<String> = self.findings.iter().map(|f| f.candidate.label()).collect();
        format!("wheel speeds tell of {}", together(&named))
    }

    /// Verdict and reason of a judgement of everything else with what was found, before the proof.
    pub fn said_with(&self, judgement: &Judgement) -> (Verdict, String) {
        if self.is_empty() {
            return (judgement.verdict, judgement.reason.clone());
        }
        let doubted = self.findings.iter().filter(|f| !f.rivals.is_empty()).map(|f| {
            let rivals: Vec<String> = f.rivals.iter().map(|m| m.candidate.label()).collect();
            format!("{} would do about as well in the place of {}", rivals.join(" or "), f.candidate.label())
        });
        let doubted: Vec<String> = doubted.collect();
        let doubt = if doubted.is_empty() { String::new() } else { format!(", but {}", doubted.join(" and ")) };
        let verdict = match judgement.verdict {
            Verdict::Ambiguous => Verdict::Ambiguous,
            _ if doubted.is_empty() => Verdict::Explained,
            _ => Verdict::Ambiguous,
        };
        (verdict, format!("{}{doubt}; beside that {}", self.named(), judgement.reason))
    }

    /// Whether nothing was found.
    pub fn is_empty(&self) -> bool {
        self.findings.is_empty()
    }
}

/// Wheel speeds of a drive, where they were measured all along.
fn measured_wheels(drive: &Trajectory) -> Option<&[[f64; WHEELS]]> {
    drive.wheel_speed_rad_s.as_deref().filter(|w| w.len() > 1 && w.iter().flatten().all(|v| v.is_finite()))
}

/// Whether wheel speeds of these drives tell the drive line: enough of them have some.
pub(crate) fn tells(vehicle: &Vehicle, drives: &[Trajectory]) -> bool {
    let servoed = vehicle.second == SecondCommand::YawRateRadS;
    servoed && drives.iter().filter(|drive| measured_wheels(drive).is_some()).count() >= DRIVES_MIN
}
