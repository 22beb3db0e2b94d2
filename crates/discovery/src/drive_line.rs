//! The drive line of a skid-steer base, told by its wheel speeds over time.
//!
//! Rims that are servoed turn as they are told, whatever the ground does, so measured wheel speeds show the drive line alone: what it makes of the commands is run freely
//! from the first sample of each drive and held against them. Ramps, limits, delays and lags differ in the course of a step, of which the means of a segment keep little.
//! Effects are chosen one after the other, all sized together each time, and doubted again beside what was found after them. What is found stands before the ground
//! or a force is asked for, which no longer have to make up for it.

use nalgebra::{DMatrix, DVector};
use nesam_physics::driveline::{DrivelineState, rim_twist};
use nesam_physics::effects::{Effect, ScheduledEffect};
use nesam_physics::{Control, RimServo, SecondCommand, Vehicle, WHEELS};
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use crate::candidates::Candidate;
use crate::claims::{Estimate, Finding, MAGNITUDE_HALF_MAX, Member, STABILITY_PARTS};
use crate::condense::part_of;
use crate::judgement::{Judgement, Verdict, together};
use crate::reference::DRIVES_MIN;
use crate::select::RIVALS_MAX;

/// Most effects of a drive line (chosen): gain, delay, lag and limits of speed and of turning.
const EFFECTS_MAX: usize = 8;
/// Share of the error of the wheel speeds that an effect takes away, at least (chosen).
const SHARE_MIN: f64 = 0.02;
/// Standard errors over drives by which the error falls with an effect, at least (chosen).
const T_MIN: f64 = 3.5;
/// Standard errors more that few drives need, times one less than their number (chosen: about what Student's t needs).
const FEW: f64 = 8.0;
/// Drives in which an effect must show.
const TELLING_MIN: usize = 4;
/// Share of the error of a drive by which it must change to say anything.
const SAME: f64 = 0.01;
/// Standard errors over drives below which two effects explain as much.
const T_RIVAL: f64 = 2.0;
/// Share by which another effect in the place of one leaves less, before it takes the place.
const BETTER: f64 = 0.01;
/// Candidates of each turn that are sized together with what was found.
const TRIED: usize = 4;
/// Rounds of the search for sizes.
const ROUNDS: usize = 12;
/// Steps of Gauss-Newton in each of them, which follow what the sizes explain together, and how often one is halved.
const STEPS: usize = 3;
const HALVINGS: i32 = 4;
/// Share of the error below which a round of it gains nothing.
const GAIN_MIN: f64 = 5e-4;
/// Most steps of drives that are looked at (chosen: half a minute on two cores), and the fewest of each drive.
const STEPS_MAX: usize = 30_000;
const STEPS_MIN: usize = 20;
/// Share of all samples below the largest ones, and shares of these at which rims are held by a limit and have come away from it.
const LARGE: f64 = 0.98;
const AT_LIMIT: f64 = 0.95;
const AWAY: f64 = 0.9;
/// Relative change of the turn efficiency from which it counts.
const EFFICIENCY_MIN: f64 = 0.05;
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

/// A drive: commands, wheel speeds (rad/s) and rim speeds left and right (m/s).
#[derive(Debug)]
struct Log<'a> {
    controls: &'a [Control<f64>],
    wheel_speed_rad_s: &'a [[f64; WHEELS]],
    rims_m_s: Vec<[f64; 2]>,
}

/// Sizes of effects that were fitted together, with the squared error of each drive, (m/s)².
#[derive(Clone, Debug, Default)]
struct Sized {
    terms: Vec<usize>,
    values: Vec<f64>,
    by_drive: Vec<f64>,
}

impl Sized {
    fn error(&self) -> f64 {
        self.by_drive.iter().sum()
    }

    /// By how many standard errors over drives another leaves more, in roots of squares: by the mean, which few drives of like size show, or by signed ranks (Wilcoxon
    /// 1945), which many of unlike size do. Drives in which both leave the same, as they never reach a limit, say nothing; zero where fewer than four say anything.
    fn less_than(&self, other: &Self) -> f64 {
        let roots = other.by_drive.iter().zip(&self.by_drive).map(|(other, own)| (other.sqrt(), own.sqrt()));
        let more: Vec<f64> = roots.filter(|(a, b)| (a - b).abs() > SAME * a.max(*b)).map(|(other, own)| other - own).collect();
        if more.len() < TELLING_MIN {
            return 0.0;
        }
        let n = more.len() as f64;
        let mean = more.iter().sum::<f64>() / n;
        let square = more.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
        // Few drives know their scatter badly.
        let by_mean = mean / (square / n).sqrt().max(1e-300) * T_MIN / (T_MIN + FEW / (n - 1.0));
        by_mean.max(signed_ranks(more))
    }
}

/// Sum of the ranks by size of what is positive, in standard deviations from what chance makes of it.
fn signed_ranks(mut values: Vec<f64>) -> f64 {
    values.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
    let n = values.len() as f64;
    let positive: f64 = values.iter().zip(1..).filter(|(v, _)| **v > 0.0).map(|(_, rank)| f64::from(rank)).sum();
    (positive - 0.25 * n * (n + 1.0)) / (n * (n + 1.0) * (2.0 * n + 1.0) / 24.0).sqrt()
}

/// Drives of a base, and what may explain them.
#[derive(Debug)]
struct Rims<'a> {
    vehicle: &'a Vehicle,
    dt_s: f64,
    logs: Vec<Log<'a>>,
    family: Vec<Candidate>,
}

impl DriveLine {
    /// From drives of a vehicle that [tell](tells) it. `family` begins at this place of the catalogue; effects in `without` are not considered.
    pub fn told_by(vehicle: &Vehicle, drives: &[Trajectory], family: &[Candidate], first: usize, without: &[String]) -> Self {
        let considered = |c: &Candidate| !without.iter().any(|id| id == c.id());
        let rims = Rims::of(vehicle, drives, family.iter().copied().filter(|c| considered(c) && c.id() != EFFICIENCY).collect());
        let place = |candidate: Candidate| first + family.iter().position(|c| *c == candidate).expect("it is of the family; this is a bug");
        let (settled, mut doubts) = rims.settled(rims.chosen());
        let (chosen, spread) = rims.sure(settled);
        if doubts.len() != chosen.terms.len() {
            doubts = (0..chosen.terms.len()).map(|i| rims.doubt(&chosen, i)).collect();
        }
        let scheduled = |values: &[f64]| rims.effects(&chosen.terms, values).into_iter().map(ScheduledEffect::from).collect::<Vec<_>>();
        let mut found = Self {
            findings: (0..chosen.terms.len()).map(|i| rims.finding(&chosen, i, spread.sd[i], &doubts[i], place)).collect(),
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

/// Whether wheel speeds of these drives tell the drive line.
pub(crate) fn tells(vehicle: &Vehicle, drives: &[Trajectory]) -> bool {
    let servoed = vehicle.second == SecondCommand::YawRateRadS;
    let measured = |d: &Trajectory| d.wheel_speed_rad_s.as_ref().is_some_and(|w| w.len() > 1 && w.iter().flatten().all(|v| v.is_finite()));
    servoed && drives.len() >= DRIVES_MIN && drives.iter().all(measured)
}

impl<'a> Rims<'a> {
    fn of(vehicle: &'a Vehicle, drives: &'a [Trajectory], family: Vec<Candidate>) -> Self {
        let most = (STEPS_MAX / drives.len()).max(STEPS_MIN);
        let log = |drive: &'a Trajectory| {
            let wheels = drive.wheel_speed_rad_s.as_deref().unwrap_or_default();
            let wheels = &wheels[..wheels.len().min(most + 1)];
            let side = |w: &[f64; WHEELS], i: usize| 0.5 * (w[i] + w[i + 2]) * vehicle.wheel_radius_m;
            let rims_m_s = wheels.iter().map(|w| [side(w, 0), side(w, 1)]).collect();
            Log { controls: &drive.controls, wheel_speed_rad_s: wheels, rims_m_s }
        };
        // A card that has a limit of the wheel speeds is tried with a share of it, one that has none with a limit.
        let limited = vehicle.limited_rims().rim_limit_m_s < RimServo::NO_LIMIT;
        let alias = if limited { "wheel_speed_limit" } else { "torque_limit" };
        let family = family.into_iter().filter(|c| c.id() != alias).collect();
        let mut logs: Vec<Log<'a>> = drives.iter().map(log).collect();
        leave_out_limited_starts(&mut logs);
        Self { vehicle, dt_s: drives[0].dt_s, logs, family }
    }

    fn effects(&self, terms: &[usize], values: &[f64]) -> Vec<Effect> {
        terms.iter().zip(values).map(|(term, value)| self.family[*term].effect(&[*value])).collect()
    }

    /// The vehicle with what was found.
    fn with(&self, sized: &Sized) -> Vehicle {
        self.vehicle.with_effects(&self.effects(&sized.terms, &sized.values))
    }

    /// The free run of a drive line, from the first sample of a drive: its state at every other sample.
    fn run(&self, vehicle: &Vehicle, log: &Log<'_>) -> impl Iterator<Item = DrivelineState> {
        let begun = DrivelineState::turning(vehicle, rim_twist(vehicle, &log.wheel_speed_rad_s[0]));
        let steps = log.controls.iter().take(log.rims_m_s.len() - 1);
        steps.scan(begun, move |state, control| {
            *state = state.advance(vehicle, control, 0.0, self.dt_s);
            Some(*state)
        })
    }

    /// Measured minus free run of both rims, m/s, at every sample of a drive but the first.
    fn deviations(&self, vehicle: &Vehicle, log: &Log<'_>) -> impl Iterator<Item = f64> {
        self.run(vehicle, log).zip(&log.rims_m_s[1..]).flat_map(move |(state, measured)| {
            let run = state.rim_speeds_m_s(vehicle);
            [measured[0] - run[0], measured[1] - run[1]]
        })
    }

    /// Squared error of each drive with effects of these sizes.
    fn by_drive(&self, terms: &[usize], values: &[f64]) -> Vec<f64> {
        let vehicle = self.vehicle.with_effects(&self.effects(terms, values));
        self.logs.par_iter().map(|log| self.deviations(&vehicle, log).map(|v| v * v).sum()).collect()
    }

    fn sized(&self, terms: Vec<usize>, values: Vec<f64>) -> Sized {
        let by_drive = self.by_drive(&terms, &values);
        Sized { terms, values, by_drive }
    }

    /// A size in the order of which an effect is sought: its own, or that of the catalogue where it is smaller.
    fn scale(&self, term: usize, value: f64) -> f64 {
        let free = &self.family[term].free()[0];
        value.abs().max(if free.mean == 0.0 { free.step } else { 0.0 })
    }

    /// All sizes sought together from where they are, one after the other with steps that shrink and all together.
    fn polished(&self, mut best: Sized) -> Sized {
        let mut error = best.error();
        for round in 0..ROUNDS {
            let before = error;
            for i in 0..best.terms.len() {
                let mut reach = 0.4 / f64::from(1 << round.min(6));
                for _ in 0..6 {
                    let by = reach * self.scale(best.terms[i], best.values[i]);
                    let trial = |by: f64| {
                        let mut values = best.values.clone();
                        let [low, high] = self.family[best.terms[i]].range(0);
                        values[i] = (values[i] + by).clamp(low, high);
                        self.sized(best.terms.clone(), values)
                    };
                    let better = [by, -by].into_iter().map(trial).find(|trial| trial.error() < error);
                    match better {
                        Some(trial) => (error, best) = (trial.error(), trial),
                        None => reach *= 0.5,
                    }
                }
            }
            for _ in 0..STEPS {
                let Some(to) = self.stepped(&best) else { break };
                (error, best) = (to.error(), to);
            }
            if round > 1 && before - error < GAIN_MIN * before {
                break;
            }
        }
        best
    }

    /// Sizes at which a term is tried first.
    fn begun(&self, term: usize) -> Vec<f64> {
        let candidate = &self.family[term];
        let ([low, high], free) = (candidate.range(0), &candidate.free()[0]);
        if free.mean != 0.0 {
            let steps = ((high / low).ln() / 1.4f64.ln()).floor() as i32;
            return (0..=steps).map(|k| low * 1.4f64.powi(k)).collect();
        }
        let sizes = (0..6).map(|k| free.step * f64::from(1 << k)).filter(|size| *size <= high);
        sizes.flat_map(|size| [size, -size]).filter(|size| *size >= low).collect()
    }

    /// The best of the first sizes of a term beside what was found.
    fn first(&self, found: &Sized, term: usize) -> Sized {
        let tried = self.begun(term).into_iter().map(|value| {
            let (mut terms, mut values) = (found.terms.clone(), found.values.clone());
            terms.push(term);
            values.push(value);
            self.sized(terms, values)
        });
        tried.min_by(|a, b| a.error().total_cmp(&b.error())).expect("every effect has a size; this is a bug")
    }

    /// What was found without one of its terms, the others sized again.
    fn dropped(&self, found: &Sized, i: usize) -> Sized {
        let (mut terms, mut values) = (found.terms.clone(), found.values.clone());
        terms.remove(i);
        values.remove(i);
        self.polished(self.sized(terms, values))
    }

    /// Whether an error falls enough.
    fn falls(from: &Sized, to: &Sized) -> bool {
        from.error() - to.error() >= SHARE_MIN * from.error()
    }

    /// Whether no size is held by the end of its range.
    fn inside(&self, sized: &Sized) -> bool {
        sized.terms.iter().zip(&sized.values).all(|(term, value)| !self.family[*term].clamp(&mut [*value])[0])
    }

    /// Effects that explain the wheel speeds.
    fn chosen(&self) -> Sized {
        let mut found = self.sized(Vec::new(), Vec::new());
        for _ in 0..2 * EFFECTS_MAX {
            if found.terms.len() == EFFECTS_MAX {
                break;
            }
            let open = (0..self.family.len()).filter(|term| !found.terms.contains(term));
            // What a size does shows only once the others have made room for it.
            let begun = open.map(|term| self.first(&found, term));
            let mut first: Vec<Sized> = begun
                .map(|begun| (0..STEPS).try_fold(begun.clone(), |at, _| self.stepped(&at).ok_or(at)).unwrap_or_else(|at| at))
                .collect();
            first.sort_by(|a, b| a.error().total_cmp(&b.error()));
            let tried = first
                .into_iter()
                .take(TRIED)
                .map(|sized| self.polished(sized))
                .filter(|sized| Self::falls(&found, sized) && self.inside(sized));
            let Some(best) = tried.min_by(|a, b| a.error().total_cmp(&b.error())) else { break };
            found = self.doubted(best);
        }
        self.proven(found)
    }

    /// What was found once nothing in the place of an effect leaves less, with what was held against each.
    fn settled(&self, mut found: Sized) -> (Sized, Vec<Doubt>) {
        for left in (0..EFFECTS_MAX).rev() {
            let doubts: Vec<Doubt> = (0..found.terms.len()).map(|i| self.doubt(&found, i)).collect();
            let instead = doubts.iter().flat_map(|doubt| &doubt.instead).min_by(|a, b| a.error().total_cmp(&b.error()));
            match instead.filter(|instead| left > 0 && instead.error() < (1.0 - BETTER) * found.error()) {
                Some(better) => found = self.proven(better.clone()),
                None => return (found, doubts),
            }
        }
        (found, Vec::new())
    }

    fn doubt(&self, found: &Sized, i: usize) -> Doubt {
        let without = self.dropped(found, i);
        Doubt { instead: self.instead(found, &without), without }
    }

    /// Others in the place of an effect, sized together with the rest. What takes away less than half of what the effect does at its first size seldom comes up to it.
    fn instead(&self, found: &Sized, without: &Sized) -> Vec<Sized> {
        let open = (0..self.family.len()).filter(|term| !found.terms.contains(term));
        let promising = |begun: &Sized| without.error() - begun.error() > 0.5 * (without.error() - found.error());
        open.map(|term| self.first(without, term)).filter(promising).map(|begun| self.polished(begun)).collect()
    }

    /// What was found, but for what is not needed beside what was found after it.
    fn doubted(&self, mut found: Sized) -> Sized {
        let mut i = 0;
        while i + 1 < found.terms.len() {
            let without = self.dropped(&found, i);
            if Self::falls(&without, &found) {
                i += 1;
            } else {
                found = without;
                i = 0;
            }
        }
        found
    }

    /// What was found, but for what drives do not surely ask for beside the rest, the weakest first: an effect may be sure only beside another that was found after it.
    fn proven(&self, mut found: Sized) -> Sized {
        loop {
            let without = (0..found.terms.len()).map(|i| self.dropped(&found, i));
            let weakest = without.map(|without| (found.less_than(&without), without)).min_by(|a, b| a.0.total_cmp(&b.0));
            match weakest {
                Some((t, without)) if t < T_MIN || !Self::falls(&without, &found) => found = without,
                _ => return found,
            }
        }
    }

    /// What was found but for what has hardly a size, with how sure the sizes are.
    fn sure(&self, mut found: Sized) -> (Sized, Spread) {
        loop {
            let spread = self.spread(&found);
            let share = |i: usize| 1.96 * spread.sd[i] / self.family[found.terms[i]].magnitude(0, found.values[i]).max(1e-12);
            let worst = (0..found.terms.len()).max_by(|a, b| share(*a).total_cmp(&share(*b)));
            match worst.filter(|i| share(*i) > MAGNITUDE_HALF_MAX) {
                Some(i) => found = self.dropped(&found, i),
                None => return (found, spread),
            }
        }
    }

    fn finding(&self, found: &Sized, i: usize, sd: f64, doubt: &Doubt, place: impl Fn(Candidate) -> usize) -> Finding {
        let candidate = self.family[found.terms[i]];
        let z = found.less_than(&doubt.without);
        let rival = |rival: &Sized| Some((*rival.terms.last()?, found.less_than(rival)));
        let mut close: Vec<(usize, f64)> = doubt.instead.iter().filter_map(rival).collect();
        close.sort_by(|a, b| a.1.total_cmp(&b.1));
        let rivals = close.iter().filter(|(_, t)| *t < T_RIVAL).take(RIVALS_MAX);
        let rivals = rivals.map(|(term, t)| (self.family[*term], (-0.5 * t.max(0.0).powi(2)).exp())).collect();
        let mut parts = [0.0; STABILITY_PARTS];
        for (d, (without, with)) in doubt.without.by_drive.iter().zip(&found.by_drive).enumerate() {
            parts[part_of(d, self.logs.len(), STABILITY_PARTS)] += without - with;
        }
        let helped = parts.iter().filter(|gain| **gain > 0.0).count();
        let told = Told {
            z,
            difference: close.first().map_or(z * z, |(_, t)| t * t.abs()),
            stability: helped as f64 / self.logs.len().min(STABILITY_PARTS) as f64,
            sd,
            rivals,
        };
        finding(candidate, place(candidate), found.values[i], told)
    }

    /// Information and score of each drive in the sizes.
    fn linearised(&self, found: &Sized) -> Vec<(DMatrix<f64>, DVector<f64>)> {
        let count = found.terms.len();
        let at = |values: &[f64]| self.vehicle.with_effects(&self.effects(&found.terms, values));
        let sides: Vec<([Vehicle; 2], f64)> = (0..count)
            .map(|i| {
                let step = 0.02 * self.scale(found.terms[i], found.values[i]);
                let moved = |by: f64| {
                    let mut values = found.values.clone();
                    values[i] += by;
                    self.family[found.terms[i]].clamp(&mut values[i..=i]);
                    (at(&values), values[i])
                };
                let [(less, low), (more, high)] = [-step, step].map(moved);
                ([less, more], high - low)
            })
            .collect();
        let here = at(&found.values);
        let of = |log: &Log<'_>| {
            let left: Vec<f64> = self.deviations(&here, log).collect();
            let slope = |([less, more], apart): &([Vehicle; 2], f64)| -> Vec<f64> {
                let pairs = self.deviations(less, log).zip(self.deviations(more, log));
                pairs.map(|(less, more)| (less - more) / apart).collect()
            };
            let slopes: Vec<Vec<f64>> = sides.iter().map(slope).collect();
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let information = DMatrix::from_fn(count, count, |i, j| dot(&slopes[i], &slopes[j]));
            let score = DVector::from_fn(count, |i, _| dot(&slopes[i], &left));
            (information, score)
        };
        self.logs.par_iter().map(of).collect()
    }

    /// A step of Gauss-Newton towards what explains all drives best, halved until it leads there; `None` where it does not.
    fn stepped(&self, found: &Sized) -> Option<Sized> {
        let count = found.terms.len();
        let zero = || (DMatrix::zeros(count, count), DVector::zeros(count));
        let (information, score) = self.linearised(found).into_iter().fold(zero(), |sum, own| (sum.0 + own.0, sum.1 + own.1));
        let step = information.cholesky()?.solve(&score);
        (0..HALVINGS).find_map(|k| {
            let mut values: Vec<f64> = found.values.iter().zip(step.iter()).map(|(v, s)| v + s * 0.5f64.powi(k)).collect();
            for (i, term) in found.terms.iter().enumerate() {
                self.family[*term].clamp(&mut values[i..=i]);
            }
            Some(self.sized(found.terms.clone(), values)).filter(|to| to.error() < found.error())
        })
    }

    /// Standard deviations over drives of the sizes, and the sizes without each drive: one step of Gauss-Newton from where all drives are explained best.
    fn spread(&self, found: &Sized) -> Spread {
        let count = found.terms.len();
        let said = self.linearised(found);
        let sum = said.iter().fold(DMatrix::zeros(count, count), |sum, (information, _)| sum + information);
        let Some(inverse) = sum.clone().cholesky().map(|c| c.inverse()) else {
            return Spread { sd: vec![f64::INFINITY; count], without: vec![found.values.clone(); said.len()] };
        };
        let total = said.iter().fold(DVector::zeros(count), |sum, (_, score)| sum + score);
        let square = said.iter().fold(DMatrix::zeros(count, count), |sum, (_, score)| sum + score * score.transpose());
        let covariance = &inverse * square * &inverse;
        let values = DVector::from_column_slice(&found.values);
        let without = said
            .iter()
            .map(|(information, score)| {
                let rest = (&sum - information).cholesky().map_or_else(|| DVector::zeros(count), |c| c.solve(&(&total - score)));
                let mut moved: Vec<f64> = (&values + rest - &inverse * &total).iter().copied().collect();
                for (i, term) in found.terms.iter().enumerate() {
                    self.family[*term].clamp(&mut moved[i..=i]);
                }
                moved
            })
            .collect();
        Spread { sd: (0..count).map(|i| covariance[(i, i)].sqrt()).collect(), without }
    }

    /// The yaw rate of the vehicle per turning of its rims, as a factor on that of its card; `None` where nobody measured the yaw rate, or it is as the card has it. The
    /// turning of the free run, which has no noise, is the instrument of that which was measured.
    fn turn_efficiency(&self, found: &Sized, drives: &[Trajectory], candidate: Candidate, hypothesis: usize) -> Option<Turning> {
        if !drives.iter().all(|d| d.measured.angular_velocity[2]) {
            return None;
        }
        let vehicle = self.with(found);
        let stated = vehicle.limited_rims().turn_efficiency;
        let said = |(log, drive): (&Log<'_>, &Trajectory)| {
            let measured = log.wheel_speed_rad_s[1..].iter().zip(&drive.states[1..]);
            self.run(&vehicle, log).zip(measured).fold([0.0; 2], |[turned, rims], (run, (wheels, state))| {
                let yaw_rate = state.angular_velocity_rad_s[2] / stated;
                [turned + run.steering * yaw_rate, rims + run.steering * rim_twist(&vehicle, wheels)[1]]
            })
        };
        let by_drive: Vec<[f64; 2]> = self.logs.iter().zip(drives).map(said).collect();
        let [turned, rims] = by_drive.iter().fold([0.0; 2], |sum, own| [sum[0] + own[0], sum[1] + own[1]]);
        let factor = turned / rims;
        let [low, high] = candidate.range(0);
        if !(rims > 0.0 && factor > low && factor < high) {
            return None;
        }
        let sd = by_drive.iter().map(|[turned, rims]| (turned - factor * rims).powi(2)).sum::<f64>().sqrt() / rims;
        let z = (factor - 1.0).abs() / sd.max(1e-300);
        let own = Told { z, difference: z * z, stability: 1.0, sd, rivals: Vec::new() };
        let without = by_drive.iter().map(|[t, r]| ((turned - t) / (rims - r)).clamp(low, high)).collect();
        let finding = finding(candidate, hypothesis, factor, own);
        (z >= T_MIN && (factor - 1.0).abs() >= EFFICIENCY_MIN).then_some(Turning { candidate, factor, without, finding })
    }
}

/// How much more slowly than the card has it a base turns than its rims.
#[derive(Debug)]
struct Turning {
    candidate: Candidate,
    factor: f64,
    /// Without each drive.
    without: Vec<f64>,
    finding: Finding,
}

impl Turning {
    fn effect(&self, factor: f64) -> ScheduledEffect {
        self.candidate.effect(&[factor]).into()
    }
}

/// Leaves out drives that begin at a limit of the speed, the turning or a rim and come away from it, unless that leaves fewer than a fourth: how far beyond the limit the command was before shows in nothing, and
/// a lag would be blamed for the time that it takes to come back to it.
fn leave_out_limited_starts(logs: &mut [Log<'_>]) {
    let sizes = |[left, right]: [f64; 2]| [(0.5 * (left + right)).abs(), (0.5 * (right - left)).abs(), left.abs().max(right.abs())];
    let largest: [f64; 3] = core::array::from_fn(|i| {
        let mut all: Vec<f64> = logs.iter().flat_map(|log| &log.rims_m_s).map(|rims| sizes(*rims)[i]).collect();
        all.sort_by(f64::total_cmp);
        all[(LARGE * (all.len() - 1) as f64) as usize]
    });
    let comes_away = |log: &Log<'_>| {
        let least = |i: usize| log.rims_m_s.iter().map(|rims| sizes(*rims)[i]).fold(f64::INFINITY, f64::min);
        (0..3).any(|i| sizes(log.rims_m_s[0])[i] > AT_LIMIT * largest[i] && least(i) < AWAY * largest[i])
    };
    let left_out: Vec<bool> = logs.iter().map(comes_away).collect();
    if 4 * left_out.iter().filter(|out| !**out).count() < logs.len() {
        return;
    }
    for (log, _) in logs.iter_mut().zip(left_out).filter(|(_, out)| *out) {
        log.rims_m_s.truncate(1);
        log.wheel_speed_rad_s = &log.wheel_speed_rad_s[..1];
    }
}

/// What was held against an effect: everything else without it, and with another in its place.
#[derive(Debug)]
struct Doubt {
    without: Sized,
    instead: Vec<Sized>,
}

/// How sure sizes are.
#[derive(Debug)]
struct Spread {
    sd: Vec<f64>,
    without: Vec<Vec<f64>>,
}

/// What is told of an effect beside its size.
#[derive(Debug)]
struct Told {
    z: f64,
    difference: f64,
    stability: f64,
    sd: f64,
    rivals: Vec<(Candidate, f64)>,
}

/// An effect of this size as a finding.
fn finding(candidate: Candidate, hypothesis: usize, value: f64, told: Told) -> Finding {
    let effect = candidate.effect(&[value]);
    let at = candidate.free()[0].parameter;
    let (parameter, quantity) = (&effect.parameters()[at], &effect.quantities()[at]);
    let half = 1.96 * told.sd;
    let end = if quantity.complete { parameter.range[1] } else { f64::INFINITY };
    let total = 1.0 + told.rivals.iter().map(|(_, weight)| weight).sum::<f64>();
    Finding {
        hypothesis,
        candidate,
        weight: 1.0 / total,
        z: told.z,
        alone: told.z,
        delta_bic: told.difference,
        stability: told.stability,
        estimates: vec![Estimate {
            name: parameter.name,
            unit: parameter.unit,
            value,
            ci95: Some([value - half, (value + half).min(end)]),
        }],
        onset: None,
        may_have_begun_s: None,
        rivals: told.rivals.iter().map(|(candidate, weight)| Member { candidate: *candidate, weight: weight / total }).collect(),
        refused: None,
        refused_for_size: false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: an effect that shows in some drives is sure, one that makes as many worse is not, and few drives say little. Method: errors of forty drives by hand, of which a
    /// limit shows in fourteen, in sizes that are most unlike.
    #[test]
    fn analytic_what_shows_in_some_drives_is_sure() {
        let sized = |squares: &[f64]| Sized { by_drive: squares.to_vec(), ..Sized::default() };
        let without: Vec<f64> = (0..40).map(|d| if d < 14 { 1.0 + 100f64.powi(d) } else { 1.0 }).collect();
        let (with, without) = (sized(&[1.0; 40]), sized(&without));
        assert_eq!(with.less_than(&sized(&[1.0; 40])), 0.0);
        // The largest outweighs the mean; all fourteen are of one sign: 14 · 15 / 4 / √(14 · 15 · 29 / 24).
        assert!((with.less_than(&without) - 52.5 / 253.75f64.sqrt()).abs() < 1e-9, "{}", with.less_than(&without));
        let either: Vec<f64> = (0..40).map(|d| if d % 2 == 0 { 1.5 } else { 0.6 }).collect();
        assert!(with.less_than(&sized(&either)).abs() < 1.0);
        assert_eq!(sized(&[1.0; 3]).less_than(&sized(&[2.0; 3])), 0.0);
    }
}
