//! What a set of drives says before the proof: effects that are chosen, sized, refused or left.

use crate::candidates::Candidate;
use crate::claims::fit::Fit;
use crate::claims::{Case, Finding};
use crate::reference::DRIVES_MIN;
use crate::select::onset::Onset;
use crate::select::settled::{Settled, onset_in_place};
use crate::select::{DECISIVE, FURTHER, RIVALS_MAX, Selection, Yardstick, without};

/// Share of the largest evidence that may be left after the claimed effects, when it is beyond chance (chosen): the model's answer to an effect is not
/// exact, but most of what is different must be explained before anything is claimed.
const LEFT_MAX: f64 = 0.4;
/// [`LEFT_MAX`] where every claimed effect is geometry, such as a steering ratio or a gyro bias.
const LEFT_MAX_GEOMETRY: f64 = 0.2;
/// [`LEFT_MAX`] of bends of actuators and sensors (chosen): a steering that turns a tenth further to one side leaves twice that and more, and none is quite straight.
const BEND_LEFT_MAX: f64 = 0.03;
/// Evidence from which a bend of a sensor speaks against a claimed effect of a sensor (chosen: beside it five bends are asked for and no other column, which by chance reach
/// that once in seventy-five times).
const BEND_OF_SENSOR: f64 = 3.0;

/// Most effects that are passed over for their size, one after the other (chosen): a class has at most three members.
const INSTEAD_MAX: usize = RIVALS_MAX + 1;

/// Outcome for a person in a hurry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing differs from the reference beyond chance.
    None,
    /// One effect, or several together, explain it and help on drives that were not fitted.
    Explained,
    /// Several effects explain it about as well.
    Ambiguous,
    /// Something differs, but no effect of the catalogue may be claimed.
    Unexplained,
}

impl Verdict {
    /// Whether effects are claimed.
    pub fn claims(self) -> bool {
        matches!(self, Self::Explained | Self::Ambiguous)
    }

    /// As in JSON.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Explained => "explained",
            Self::Ambiguous => "ambiguous",
            Self::Unexplained => "unexplained",
        }
    }
}

/// A judgement without the proof on held-out drives.
#[derive(Debug)]
pub struct Judgement {
    /// Selection on all fitted drives.
    pub selection: Selection,
    /// Findings, refused or not.
    pub findings: Vec<Finding>,
    /// Onset of each hypothesis, where one was looked for and is sure.
    pub onsets: Vec<Option<Onset>>,
    /// What was compared through the physics with each of the first findings; `None` for one with which nothing was.
    pub settled: Vec<Option<Settled>>,
    /// Fit of all chosen effects together; `None` when nothing was chosen.
    pub fit: Option<Fit>,
    /// Verdict before the proof.
    pub verdict: Verdict,
    /// Why.
    pub reason: String,
}

impl Judgement {
    /// Positions in the findings of those that may be claimed.
    pub fn claimed(&self) -> Vec<usize> {
        let any = self.verdict.claims();
        (0..self.findings.len()).filter(|i| any && self.findings[*i].refused.is_none()).collect()
    }

    /// The same with what earlier looks refused, which is named where nothing else stands out.
    pub(crate) fn with_refused(mut self, refused: Vec<Finding>) -> Self {
        self.reason = self.naming(&refused).unwrap_or(self.reason);
        self.findings.extend(refused);
        self
    }

    /// The reason where nothing is chosen and one of these findings stands out but was refused.
    fn naming(&self, refused: &[Finding]) -> Option<String> {
        let nothing_else = self.verdict == Verdict::Unexplained && self.selection.chosen.is_empty();
        let standing_out = refused.iter().filter(|f| nothing_else && f.z >= self.selection.threshold);
        let Finding { candidate, z, refused: Some(why), .. } = standing_out.max_by(|a, b| a.z.total_cmp(&b.z))? else { return None };
        let ((most, what), label) = (&self.selection.remaining, candidate.label());
        Some(format!("{DIFFER_FROM_MODEL}, most in {what} (z = {most:.1}); {label} stands out (z = {z:.1}) but was refused: {why}"))
    }

    /// The same with all claims refused for this reason; `said` says so.
    pub(crate) fn unproven(mut self, why: &str, said: String) -> Self {
        for i in self.claimed() {
            self.findings[i].refused = Some(why.into());
        }
        Self { verdict: Verdict::Unexplained, reason: said, ..self }
    }

    /// The same without one of its claims, which is refused for this reason: the others are settled and sized again.
    pub(crate) fn dropping(mut self, case: &Case<'_>, yardstick: &Yardstick, i: usize, why: String) -> Self {
        let dropped = self.selection.chosen[i];
        self.findings[i].refused = Some(why);
        let others = without(&self.selection.chosen, i);
        self.selection.choose(yardstick, &yardstick.group(case.condensed()), others);
        let left_out = self.findings.into_iter().filter(|f| f.refused.is_some()).collect();
        let judgement = concluded(case, yardstick, self.selection, self.onsets, &[dropped], left_out);
        let reason = judgement.naming(&judgement.findings).unwrap_or_else(|| judgement.reason.clone());
        unless_unrest(case, yardstick, Judgement { reason, ..judgement })
    }
}

/// Detects, selects and sizes, without the proof.
pub fn judge(case: &mut Case<'_>, yardstick: &Yardstick) -> Judgement {
    let (selection, onsets) = case.select(yardstick);
    let judgement = concluded(case, yardstick, selection, onsets, &[], Vec::new());
    unless_unrest(case, yardstick, rival_instead(case, yardstick, judgement))
}

/// What drives say that are too few to claim anything by the scatter of their own: what stands out, of which nothing is chosen.
pub(crate) fn too_few(case: &Case<'_>, yardstick: &Yardstick) -> Judgement {
    let none = Yardstick { withheld: (0..yardstick.catalogue.len()).collect(), ..yardstick.clone() };
    let selection = none.select(&none.group(case.condensed()));
    let (verdict, told) = nothing_chosen(&selection, yardstick.model_on_trial);
    let drives = case.prepared.len();
    let least = selection.probability.map_or(1.0, |[_, least]| least);
    let most = &selection.remaining.1;
    let few = format!(
        "{drives} drives are too few to claim an effect of the model itself: their signs show no probability below {least:.3}; it takes {DRIVES_MIN}"
    );
    let reason = if verdict == Verdict::None { format!("{few}; what stands out most is {most}") } else { format!("{told}; {few}") };
    let onsets = vec![None; yardstick.catalogue.len()];
    Judgement { selection, findings: Vec::new(), onsets, settled: Vec::new(), fit: None, verdict, reason }
}

/// That nothing differs is said where sensors do not wander or jump either.
fn unless_unrest(case: &Case<'_>, yardstick: &Yardstick, judgement: Judgement) -> Judgement {
    if judgement.verdict != Verdict::None {
        return judgement;
    }
    let Some(unrest) = case.unrest(yardstick) else { return judgement };
    let reason = format!("{unrest}, which no effect of the catalogue explains");
    Judgement { verdict: Verdict::Unexplained, reason, ..judgement }
}

/// Settles, sizes and doubts what is chosen until nothing is refused, or only the first is left. What is `passed_over` takes no place; `left_out` was refused before.
fn concluded(
    case: &Case<'_>,
    yardstick: &Yardstick,
    mut selection: Selection,
    mut onsets: Vec<Option<Onset>>,
    passed_over: &[usize],
    mut left_out: Vec<Finding>,
) -> Judgement {
    let group = yardstick.group(case.condensed());
    loop {
        let settled = case.settle(yardstick, &mut selection, &mut onsets, passed_over);
        if selection.chosen.is_empty() {
            let (verdict, reason) = nothing_chosen(&selection, yardstick.model_on_trial);
            return Judgement { selection, findings: left_out, onsets, settled, fit: None, verdict, reason };
        }
        let fit = case.size(yardstick, &group, &selection.chosen, &onsets);
        let mut findings = case.findings(yardstick, &selection, &onsets, &fit, &settled);
        // A further effect that may not be claimed is dropped and the others are sized again without it.
        let dropped = findings.iter().rposition(|f| f.refused.is_some());
        match dropped {
            Some(i) if findings.len() > 1 => {
                let refused = findings.remove(i);
                // What is refused again is listed once.
                left_out.retain(|before| before.hypothesis != refused.hypothesis);
                left_out.push(refused);
                let others = without(&selection.chosen, i);
                selection.choose(yardstick, &group, others);
            }
            _ => {
                let (verdict, reason) = provisional(&selection, &findings, yardstick.model_on_trial);
                left_out.retain(|dropped| findings.iter().all(|f| f.hypothesis != dropped.hypothesis));
                findings.extend(left_out);
                return Judgement { selection, findings, onsets, settled, fit: Some(fit), verdict, reason };
            }
        }
    }
}

/// Where the only effect that is left is refused for its size, its closest rival of another id, if that may be claimed: a payload whose size nobody can tell is seldom
/// one. A rival that is refused for its size too gives way to the next one. A model on trial takes one effect after the other and tries each for itself.
fn rival_instead(case: &Case<'_>, yardstick: &Yardstick, judgement: Judgement) -> Judgement {
    if yardstick.model_on_trial {
        return judgement;
    }
    let (mut passed_over, mut last) = (Vec::new(), None);
    while passed_over.len() < INSTEAD_MAX {
        let refused = last.as_ref().unwrap_or(&judgement);
        let Some(first) = refused.findings.first().filter(|f| f.refused_for_size) else { break };
        passed_over.push(first.hypothesis);
        let Some(rival) = closest_of_another_id(&refused.selection, &yardstick.catalogue, &passed_over) else { break };
        let (mut selection, mut onsets) = (refused.selection.clone(), refused.onsets.clone());
        onsets[rival] = onset_in_place(&onsets, rival, first.hypothesis);
        selection.choose(yardstick, &yardstick.group(case.condensed()), vec![rival]);
        let instead = concluded(case, yardstick, selection, onsets, &passed_over, refused.findings.clone());
        if !instead.claimed().is_empty() {
            return instead;
        }
        last = Some(instead);
    }
    judgement
}

/// The closest rival of the only chosen hypothesis that has an id of which nothing is `passed_over` and is not decided against.
fn closest_of_another_id(selection: &Selection, catalogue: &[Candidate], passed_over: &[usize]) -> Option<usize> {
    if selection.chosen.len() != 1 {
        return None;
    }
    let close = selection.rivals[0].iter().filter(|r| r.difference < DECISIVE);
    close.map(|r| r.hypothesis).find(|h| passed_over.iter().all(|p| catalogue[*h].id() != catalogue[*p].id()))
}

/// That drives differ from a model on trial.
const DIFFER_FROM_MODEL: &str = "the drives are not as the model predicts";

fn differ(model_on_trial: bool) -> &'static str {
    if model_on_trial { DIFFER_FROM_MODEL } else { "the drives differ from the reference" }
}

fn nothing_chosen(selection: &Selection, model_on_trial: bool) -> (Verdict, String) {
    if !surely_differs(selection) && selection.differs() {
        let z = selection.largest();
        return (Verdict::None, format!("the evidence that anything differs is weak (z = {z:.1}), and no effect may be claimed"));
    }
    if selection.differs() {
        let (z, what) = &selection.remaining;
        return (
            Verdict::Unexplained,
            format!("{}, most in {what} (z = {z:.1}), but no effect of the catalogue stands out", differ(model_on_trial)),
        );
    }
    let nothing = if model_on_trial { "the model errs to no side on average" } else { "nothing stands out from drives without an effect" };
    (Verdict::None, nothing.into())
}

/// Whether the drives differ from the reference beyond doubt, so that it must be said even when no cause can be named: before or after what was tried, which may show what
/// it does not explain.
fn surely_differs(selection: &Selection) -> bool {
    selection.largest().max(selection.remaining.0) >= selection.beyond_doubt()
}

/// What is left and speaks against what is chosen: a level beyond chance, or a hypothesis that could be chosen besides, of more than this share of the largest evidence; or
/// a bend, of more than [`BEND_LEFT_MAX`] of it, where an effect of a sensor is claimed those of sensors from [`BEND_OF_SENSOR`] on.
fn left_over(selection: &Selection, share_max: f64) -> Option<&(f64, String)> {
    let needed = |times: f64, share: f64| (times * selection.threshold).max(share * selection.largest());
    let all = [
        (&selection.remaining, needed(FURTHER, share_max)),
        (&selection.remaining_level, needed(1.0, share_max)),
        (&selection.remaining_bend, needed(FURTHER, BEND_LEFT_MAX)),
        (&selection.remaining_bend_of_sensor, BEND_OF_SENSOR.max(BEND_LEFT_MAX * selection.largest())),
    ];
    all.into_iter().find(|(left, needed)| left.0 >= *needed).map(|(left, _)| left)
}

fn provisional(selection: &Selection, findings: &[Finding], model_on_trial: bool) -> (Verdict, String) {
    let first = &findings[0];
    if let Some(refused) = first.refused.as_ref().filter(|_| !surely_differs(selection)) {
        let (z, label) = (selection.largest(), first.candidate.label());
        return (
            Verdict::None,
            format!("the evidence that anything differs is weak (z = {z:.1}), and {label} cannot be claimed: {refused}"),
        );
    }
    if let Some(refused) = &first.refused {
        return (Verdict::Unexplained, format!("{}, but {} cannot be claimed: {refused}", differ(model_on_trial), first.candidate.label()));
    }
    let force = findings.iter().any(|f| f.candidate.through_contact());
    let left = left_over(selection, if force { LEFT_MAX } else { LEFT_MAX_GEOMETRY });
    if let Some((left, what)) = left.filter(|_| !model_on_trial) {
        return (
            Verdict::Unexplained,
            format!(
                "{} explains too little: {what} still stands out with z = {left:.1} of {:.1}",
                first.candidate.label(),
                selection.largest()
            ),
        );
    }
    let named: Vec<String> = findings.iter().map(|f| f.candidate.label()).collect();
    let rivals: Vec<String> = findings.iter().flat_map(|f| &f.rivals).map(|m| m.candidate.label()).collect();
    let more = if model_on_trial { String::new() } else { more_left(selection) };
    if rivals.is_empty() {
        (Verdict::Explained, format!("{} explains it{more}", together(&named)))
    } else {
        (Verdict::Ambiguous, format!("{} explains it, but {} would do about as well{more}", together(&named), rivals.join(" or ")))
    }
}

/// What is left beyond doubt beside claimed effects, and what to do: a share of what loud effects explain may be much.
fn more_left(selection: &Selection) -> String {
    let (z, what) = &selection.remaining;
    if *z < selection.beyond_doubt() {
        return String::new();
    }
    format!("; more is left, most in {what} (z = {z:.1}): diagnose once more with the bundle that has them")
}

pub(crate) fn together(named: &[String]) -> String {
    match named {
        [first, others @ ..] if !others.is_empty() => format!("{first} with {}", others.join(" and ")),
        _ => named.concat(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::candidates::catalogue;
    use crate::select::Rival;

    /// Goal: what stands in for an effect that is refused for its size is close to it and something else. Method: a drag of one wheel with rivals: other wheels, then a
    /// tow that is close or decided against, or was refused before.
    #[test]
    fn analytic_the_closest_rival_of_another_id_stands_in() {
        let catalogue = catalogue(&[]);
        let at = |label: &str| catalogue.iter().position(|c| c.label() == label).unwrap();
        let beside = |chosen: &[&str], rivals: &[(&str, f64)], refused: &[&str]| {
            let rivals: Vec<Rival> =
                rivals.iter().map(|(label, difference)| Rival { hypothesis: at(label), difference: *difference }).collect();
            let selection = Selection {
                chosen: chosen.iter().map(|label| at(label)).collect(),
                rivals: vec![rivals; chosen.len()],
                ..Selection::empty(4.0)
            };
            closest_of_another_id(&selection, &catalogue, &refused.iter().map(|label| at(label)).collect::<Vec<_>>())
        };
        let stands_in = |chosen: &[&str], rivals: &[(&str, f64)]| beside(chosen, rivals, &chosen[..1]);
        let close = [("wheel_drag RR", 0.5), ("tow", 5.9), ("linear_drag", 5.95)];
        assert_eq!(stands_in(&["wheel_drag FR"], &close), Some(at("tow")));
        assert_eq!(stands_in(&["wheel_drag FR"], &[("wheel_drag RR", 0.5), ("tow", 6.1)]), None);
        assert_eq!(stands_in(&["wheel_drag FR", "gyro_bias"], &close), None, "the other one can be claimed");
        assert_eq!(beside(&["wheel_drag FR"], &close, &["tow", "wheel_drag FR"]), Some(at("linear_drag")));
    }

    /// A selection of this largest evidence, of which these are left: of anything, and of levels.
    fn leaving(largest: f64, [any, level]: [f64; 2]) -> Selection {
        Selection {
            z: vec![Some(largest)],
            remaining: (any, "anything".into()),
            remaining_level: (level, "a level".into()),
            ..Selection::empty(4.0)
        }
    }

    /// Goal: what is left counts as a difference too. Method: evidence before and after what was tried, either side of one and a half thresholds of 4.
    #[test]
    fn analytic_more_left_than_there_was_is_a_difference() {
        assert!(surely_differs(&leaving(5.3, [7.8, 7.8])));
        assert!(surely_differs(&leaving(6.1, [2.0, 2.0])));
        assert!(!surely_differs(&leaving(5.7, [5.6, 5.6])));
    }

    /// Goal: a hypothesis that could not be chosen besides refuses nothing, a level beyond chance does. Method: what is left of an evidence of 14, on a threshold of 4.
    #[test]
    fn analytic_what_could_not_be_chosen_refuses_no_claim() {
        let refused_by = |left: [f64; 2]| left_over(&leaving(14.0, left), 0.2).map(|(_, what)| what.clone());
        assert_eq!(refused_by([4.7, 3.0]), None);
        assert_eq!(refused_by([5.1, 3.0]).as_deref(), Some("anything"));
        assert_eq!(refused_by([4.7, 4.2]).as_deref(), Some("a level"));
        assert!(left_over(&leaving(30.0, [5.1, 5.1]), 0.2).is_none(), "less than a fifth");
        let beside_a_sensor =
            |z: f64, largest: f64| Selection { remaining_bend_of_sensor: (z, "a bend".into()), ..leaving(largest, [z, 0.0]) };
        assert!(left_over(&beside_a_sensor(2.9, 14.0), 0.2).is_none() && left_over(&beside_a_sensor(3.1, 14.0), 0.2).is_some());
        assert!(left_over(&beside_a_sensor(3.1, 110.0), 0.2).is_none(), "less than three in a hundred");
    }

    /// Goal: a reason does not say that nothing stands out where something was refused. Method: two findings that earlier looks refused, with nothing chosen and with
    /// another verdict.
    #[test]
    fn analytic_what_was_refused_is_named_where_nothing_else_stands_out() {
        let catalogue = catalogue(&[]);
        let finding = |id: &str, z: f64| {
            let refused = Some(format!("{id} does not help"));
            Finding { refused, ..Finding::of(&catalogue, id, z, Vec::new()) }
        };
        let judged = |verdict: Verdict, refused: Vec<Finding>| {
            let left = (146.1, "a level".to_string());
            let selection = Selection { levels: vec![146.1], remaining: left.clone(), remaining_level: left, ..Selection::empty(4.0) };
            let reason = nothing_chosen(&selection, false).1;
            let judgement =
                Judgement { selection, findings: Vec::new(), onsets: Vec::new(), settled: Vec::new(), fit: None, verdict, reason };
            judgement.with_refused(refused)
        };
        let named = judged(Verdict::Unexplained, vec![finding("tow", 5.4), finding("gyro_bias", 148.0)]);
        let end = "most in a level (z = 146.1); gyro_bias stands out (z = 148.0) but was refused: gyro_bias does not help";
        assert!(named.reason.ends_with(end), "{}", named.reason);
        assert_eq!(named.findings.len(), 2);
        for reason in [judged(Verdict::Unexplained, Vec::new()).reason, judged(Verdict::None, vec![finding("tow", 5.4)]).reason] {
            assert!(reason.ends_with("no effect of the catalogue stands out"), "{reason}");
        }
    }
}
