//! The JSON (`nesam.diagnose/1`) and the HTML page of a diagnosis.

use nesam_evaluation::report::{LinePlot, Page, Series, Short, Table};
use nesam_evaluation::{DIMENSION_KEYS, ErrorSummary, ErrorTree, ModelScore, POSE_DIM, Provenance, paired_difference};
use nesam_physics::effects::Layer;
use serde_json::{Value, json};

use crate::candidates::Candidate;
use crate::candidates::bend::Bend;
use crate::claims::{Estimate, Finding, Trace};
use crate::diagnose::{Against, Diagnosis};
use crate::observe::channels;
use crate::proof::controls::Kind;
use crate::select::manoeuvre;

/// Version of the rule by which a diagnosis stops.
pub const STOP_RULE: &str = "20: a rival that is refused for its size gives way to the next; effects of a model on trial on other ground than its map shows stand on a soil of their own, as others do; ground that no map tells of sought from what is assumed and from hard ground; each sensor of a model on trial held by itself against what measurements contradict, in the channels that it changes by more than is negligible; the soil that fits best alone counts where it predicts better; a gyro or a velocity whose error bends with what it measures is a difference, as an actuator that bends is; a steering whose answer is S-shaped beside what is claimed is a difference; a bend refutes by more than 3 % of the largest evidence; an error that rises refutes by more than a tenth of the largest share by which another surely falls; of a model on trial nothing is claimed by fewer than eight drives, and what is claimed is proven by the fitted drives alone; a model on trial that errs to no side and more than twice as far as a vehicle that goes on as it begins is not right; the drive line of a base on trial whose wheel speeds are measured told by these over time, then of a model on trial up to four effects, on ground that is fitted where no map tells it; a step of a fit that leaves more is halved; an actuator that bends as it is commanded beside what is claimed is a difference; what a proof refutes is withheld and the rest judged again; each fitted effect doubted by its own share; up to three effects, each dated beside the others and held against its rivals; of several each force, soil and actuator proven by itself, without a proof 2.5 thresholds; height, roll and pitch count on a map only; segments in which an effect begins do not count, and each has one size; sensors that wander or jump are a difference; a map answers through the ground; pairwise criterion 6; at most 40 % of the largest evidence left, 20 % for geometry; what varies within drives believed as far as they agree; a factor known by its distance from 1";
const STAGES: [&str; 3] = ["before", "soil only", "after"];

/// What a report is made from.
#[derive(Clone, Copy, Debug)]
pub struct Report<'a> {
    /// Name of the set.
    pub set: &'a str,
    /// Findings.
    pub diagnosis: &'a Diagnosis,
    /// Folder of the patched bundle, where one was written.
    pub bundle: Option<&'a str>,
    /// Folder of the bundle that has the free form too, where one was written.
    pub free_form_bundle: Option<&'a str>,
    /// What it was computed from.
    pub provenance: &'a Provenance,
    /// Step of the model, s.
    pub dt_s: f64,
    /// What the drives were held against.
    pub against: Against,
    /// What does not fit together in the drives themselves, by which a claim may be wrong: units, signs, frames.
    pub doubts: &'a [String],
    /// What else to know of the drives.
    pub notes: &'a [String],
}

impl Report<'_> {
    /// The JSON document.
    pub fn to_json(&self) -> String {
        let d = self.diagnosis;
        // Where no drive is held out, every number is null and there are no windows.
        let stage = |i: usize| d.scores.as_ref().map_or_else(ErrorSummary::default, |s| s.scores[i].summary.clone());
        let compared = d.scores.as_ref().map(|s| paired_difference(&s.scores[1].errors, &s.scores[2].errors, &s.resamples));
        let (improvement, improvement_ci95) = compared.unwrap_or_default();
        let mut document = json!({
            "schema": "nesam.diagnose/1",
            "set": self.set,
            "verdict": d.verdict.as_str(),
            "effects": self.effects(),
            "fit_on": d.fit_on,
            "held_out": d.held_out,
            "before": stage(0),
            "soil_only": stage(1),
            "after": stage(2),
            "improvement_ci95": improvement_ci95,
            "controls": self.controls(),
            "attainable_p": d.selection.probability.map(|[_, attainable]| attainable),
            "bundle": self.bundle,
            "reason": d.reason,
            "improvement": improvement,
            "p_family_wise": d.selection.probability.map(|[p, _]| p),
            "threshold_z": d.selection.threshold,
            "remaining": {"z": d.selection.remaining.0, "what": d.selection.remaining.1},
            "considered": self.considered(),
            "learned_per_held_out_drive": self.learned(),
            "stop_rule": STOP_RULE,
            "reference": match self.against { Against::Bundle => "bundle", Against::Physics => "physics" },
            "doubts": self.doubts,
            "notes": self.notes,
            "provenance": self.provenance,
        });
        let map = document.as_object_mut().expect("an object was built; this is a bug");
        map.insert("soils".into(), json!(d.soils.map(|s| json!({"assumed": s.assumed, "alone": s.alone, "beside_effects": s.beside}))));
        map.insert("levels".into(), self.levels());
        map.insert("bends".into(), self.bends());
        if !d.left_out.is_empty() {
            map.insert("left_out_channels".into(), json!(d.left_out.iter().map(|c| channels::name(*c)).collect::<Vec<_>>()));
            map.insert("unseen_effects".into(), json!(d.unseen));
        }
        serde_json::to_string_pretty(&document).expect("finite numbers and text always serialise; this is a bug") + "\n"
    }

    /// What would expose a fake.
    fn controls(&self) -> Value {
        let d = self.diagnosis;
        let scores = d.scores.as_ref();
        let early = scores.and_then(|s| s.before_onset.as_ref());
        let of = |wanted: &dyn Fn(&Kind) -> bool| -> Vec<Value> {
            self.control_scores()
                .filter(|(kind, ..)| wanted(kind))
                .map(|(kind, parameters, score)| control_json(kind, parameters, score))
                .collect()
        };
        let free_form = of(&|k| matches!(k, Kind::FreeForm)).pop().map(|mut tree| {
            if let (Some(map), Some(effect)) = (tree.as_object_mut(), &d.free_form) {
                let parameters: Vec<Value> =
                    effect.parameters().iter().map(|p| json!({"name": p.name, "unit": p.unit, "value": p.value})).collect();
                map.insert("effect".into(), json!({"id": effect.id(), "layer": effect.layer().as_str(), "parameters": parameters}));
                // It is fitted to what the claimed effects leave; without a claim, to everything.
                let before = if d.claimed.is_empty() { 0 } else { 2 };
                map.insert("before".into(), json!(scores.map(|s| &s.scores[before].summary)));
                map.insert("bundle".into(), json!(self.free_form_bundle));
            }
            tree
        });
        let null_drives = d.null_drives.as_ref().map(|n| {
            json!({
                "drives": n.null.len(),
                "helped": n.null.iter().filter(|g| **g > 0.0).count(),
                "mean_gain": mean(&n.null),
                "mean_gain_on_these_drives": mean(&n.fitted),
                "unit": "fall of the squared distance of a drive, in the metric of the reference, by the fitted size",
            })
        });
        json!({
            "black_box_refit": of(&|k| matches!(k, Kind::BlackBox)).pop().unwrap_or_else(|| json!(ErrorSummary::default())),
            "placebo_rival": of(&|k| matches!(k, Kind::Placebo(_))).pop(),
            "rivals_refitted": of(&|k| matches!(k, Kind::Rival(_))),
            "before_onset": early.map(|[_, after]| &after.summary),
            "before_onset_without_effect": early.map(|[before, _]| &before.summary),
            "free_form": free_form,
            "null_drives": null_drives,
        })
    }

    /// Kind, number of parameters and score of each control.
    fn control_scores(&self) -> impl Iterator<Item = (Kind, usize, &ModelScore)> {
        let d = self.diagnosis;
        d.controls.iter().zip(d.scores.iter().flat_map(|s| &s.controls)).map(|((kind, parameters), score)| (*kind, *parameters, score))
    }

    /// Mean deviation of every compared channel and how unusual it is.
    fn levels(&self) -> Value {
        let d = self.diagnosis;
        let of = |i: usize| {
            let c = d.channels[i];
            json!({"channel": channels::name(c), "layer": channels::layer(c), "difference": d.levels[i], "z": d.selection.levels[i]})
        };
        (0..d.channels.len()).map(of).collect()
    }

    /// How unusually actuators bend as they are commanded, and sensors as what they measure.
    fn bends(&self) -> Value {
        let d = self.diagnosis;
        let of = |(z, Bend { channel, shape }): (f64, Bend)| json!({"channel": channels::name(channel), "layer": channels::layer(channel), "shape": shape, "z": z});
        d.bends_seen().into_iter().map(of).collect()
    }

    /// The claimed effects, each with its rivals: an equivalence class of at most three, weights of which sum to 1.
    fn effects(&self) -> Vec<Value> {
        self.diagnosis.claims().map(effect_json).collect()
    }

    fn considered(&self) -> Vec<Value> {
        let d = self.diagnosis;
        let of = |(e, c): (usize, &Candidate)| {
            let finding = d.findings.iter().find(|f| f.hypothesis == e);
            json!({"hypothesis": c.label(), "z": d.selection.z[e], "chosen": finding.is_some(), "refused": finding.and_then(|f| f.refused.clone())})
        };
        d.catalogue.iter().enumerate().map(of).collect()
    }

    fn learned(&self) -> Vec<Value> {
        let d = self.diagnosis;
        d.held_out
            .iter()
            .zip(&d.learned)
            .map(|(id, l)| {
                let effects: Vec<Value> = l
                    .effects
                    .iter()
                    .map(|e| json!({"id": e.effect.id(), "onset_s": e.onset_s, "values": e.effect.parameters().iter().map(|p| p.value).collect::<Vec<_>>()}))
                    .collect();
                json!({"trajectory": id, "effects": effects, "soil_correction": l.soil.delta})
            })
            .collect()
    }

    /// What was not compared, and which effects therefore cannot be seen, as a sentence; `None` where drives measure all that the reference compares.
    pub fn left_out(&self) -> Option<String> {
        let d = self.diagnosis;
        if d.left_out.is_empty() {
            return None;
        }
        let named: Vec<String> = d.left_out.iter().map(|c| channels::name(*c)).collect();
        let unseen = if d.unseen.is_empty() {
            "every effect can be seen without them".into()
        } else {
            format!("without them these effects cannot be seen: {}", d.unseen.join(", "))
        };
        Some(format!("Not compared, because a drive does not measure it, or has no map: {}; {unseen}.", named.join(", ")))
    }

    /// The page.
    pub fn to_html(&self) -> String {
        let d = self.diagnosis;
        let scored = match d.held_out.len() {
            held_out if d.held_out == d.fit_on => format!("Each of {held_out} drives is scored with what the others taught."),
            held_out => format!("Fitted on {} drives, scored on {held_out} that were not fitted.", d.fit_on.len()),
        };
        let lead = format!("Verdict on set {}: {} - {}. {scored}", self.set, d.verdict.as_str(), d.reason);
        let mut page = Page::new(&format!("nesam diagnose: {}", self.set), &lead);
        for note in self.notes {
            page.text(note);
        }
        if !self.doubts.is_empty() {
            page.section("What does not fit together in the drives")
                .text("A claim may be wrong by this: mend the log first, and see what `nesam check` says of it.");
            for doubt in self.doubts {
                page.text(doubt);
            }
        }
        let seen = page
            .section("What was seen")
            .text("Mean deviation of every channel from the frozen reference, by residual layer; z is against groups of drives without an effect.");
        if let Some(left_out) = self.left_out() {
            seen.text(&left_out);
        }
        seen.table(&self.level_table()).table(&self.bend_table());
        let traces: Vec<LinePlot> = d.traces.iter().map(trace_plot).collect();
        page.section("The most unusual channel of each layer").plots(
            &traces,
            "Mean over the drives of the deviation from the reference in segments of 0.8 s, without and with the claimed effects.",
        );
        page.section("What was considered")
            .text(&format!(
                "Evidence against the scatter of drives without an effect; below z = {:.2} nothing is claimed.",
                d.selection.threshold
            ))
            .table(&self.hypothesis_table());
        for apart in to_tell_apart(d) {
            page.text(&apart);
        }
        if !d.estimates.is_empty() && d.verdict.claims() {
            page.section("What was added").table(&self.estimate_table());
        }
        if let Some(scores) = &d.scores {
            page.section("Error before, with soil alone, after").table(&self.error_table());
            let plots: Vec<LinePlot> = (0..=POSE_DIM).rev().map(|c| self.curve(scores, c)).collect();
            self.controls_section(&mut page);
            page.section("Error over the horizon")
                .plots(&plots, "Mean absolute error after each step on drives that were not fitted; bands are 95 % intervals.");
        }
        page.made_from(self.provenance).footer("stop rule", STOP_RULE);
        page.render()
    }

    fn controls_section(&self, page: &mut Page) {
        let rows: Vec<_> = self.control_scores().collect();
        if rows.is_empty() {
            return;
        }
        let head: Vec<&str> =
            ["control", "parameters"].into_iter().chain(DIMENSION_KEYS).chain(["position mean [m]", "position at K [m]"]).collect();
        let mut table = Table::new("Mean absolute error over the horizon on held-out drives", &head);
        let named = self.stages().into_iter().filter(|(name, _)| *name != STAGES[1]).map(|(name, tree)| (name.to_string(), None, tree));
        let controls = rows.iter().map(|(kind, parameters, score)| (control_name(kind), Some(*parameters), &score.summary.tree));
        for (name, parameters, tree) in named.chain(controls) {
            let numbers = tree.mae_mean.to_array().into_iter().chain([tree.position_m.mean, tree.position_m.final_]);
            let cells = numbers.map(|v| v.map_or("-".to_string(), |v| format!("{v:.3}")).into());
            table.row([name.into(), parameters.map_or("-".to_string(), |p| p.to_string()).into()].into_iter().chain(cells).collect());
        }
        page.section("Controls that would expose a fake")
            .text(
                "The same held-out drives with what else might explain them: the strongest hypothesis that was not named, each rival refitted in the place of the named effect, \
                 the refitted head of the learned residual (no physics, no effect), and the named effects with a bounded free-form wrench fitted to what they leave, \
                 which has no cause and no name. A named effect earns its place when it does with a few parameters what the black box needs many for.",
            )
            .table(&table);
        if let Some(n) = &self.diagnosis.null_drives {
            page.text(&format!(
                "On {} drives without an effect the same sizes would lower the squared distance of {} (mean change {:+.1} a drive); on these drives the mean is {:+.1}.",
                n.null.len(),
                n.null.iter().filter(|g| **g > 0.0).count(),
                -mean(&n.null),
                -mean(&n.fitted)
            ));
        }
        if let Some(effect) = &self.diagnosis.free_form {
            let mut table = Table::new("The free form: coefficients and valid region", &["parameter", "value", "unit"]);
            for p in effect.parameters() {
                table.row(vec![p.name.into(), Short(p.value).to_string().into(), p.unit.into()]);
            }
            page.table(&table);
        }
    }

    fn level_table(&self) -> Table {
        let mut table = Table::new("Levels of the channels, most unusual first", &["channel", "layer", "difference", "z"]);
        let d = self.diagnosis;
        let mut order: Vec<usize> = (0..d.channels.len()).collect();
        order.sort_by(|a, b| d.selection.levels[*b].total_cmp(&d.selection.levels[*a]));
        for i in order.into_iter().take(14) {
            let c = d.channels[i];
            table.row(vec![
                channels::name(c).into(),
                channels::layer(c).into(),
                format!("{:+.4}", d.levels[i]).into(),
                format!("{:.1}", d.selection.levels[i]).into(),
            ]);
        }
        table
    }

    fn bend_table(&self) -> Table {
        let mut table = Table::new("Whether actuators and sensors answer along straight lines", &["what", "layer", "z"]);
        for (z, bend) in self.diagnosis.bends_seen() {
            table.row(vec![bend.name().into(), channels::layer(bend.channel).into(), format!("{z:.1}").into()]);
        }
        table
    }

    fn hypothesis_table(&self) -> Table {
        let mut table = Table::new("Hypotheses, strongest evidence first", &["hypothesis", "layer", "z", "size", "outcome"]);
        let d = self.diagnosis;
        let mut order: Vec<usize> = (0..d.catalogue.len()).filter(|e| d.selection.z[*e].is_some()).collect();
        order.sort_by(|a, b| d.selection.z[*b].unwrap_or(0.0).total_cmp(&d.selection.z[*a].unwrap_or(0.0)));
        for e in order {
            let finding = d.findings.iter().find(|f| f.hypothesis == e);
            let rival_of = d.findings.iter().find(|f| f.rivals.iter().any(|r| r.candidate == d.catalogue[e]));
            let outcome = match (finding, rival_of) {
                (Some(f), _) => f.refused.clone().map_or("chosen".into(), |why| format!("refused: {why}")),
                (None, Some(f)) => format!("rival of {}", f.candidate.label()),
                _ => String::new(),
            };
            table.row(vec![
                d.catalogue[e].label().into(),
                layer_name(d.catalogue[e].layer()).into(),
                format!("{:.1}", d.selection.z[e].unwrap_or(0.0)).into(),
                finding.map_or(String::new(), describe).into(),
                outcome.into(),
            ]);
        }
        table
    }

    fn estimate_table(&self) -> Table {
        let mut table = Table::new("Parameters with 95 % intervals", &["effect", "parameter", "value", "interval", "unit"]);
        for finding in named(self.diagnosis) {
            for e in &finding.estimates {
                let interval = e.ci95.map_or("-".into(), |[l, h]| format!("[{}, {}]", Short(l), Short(h)));
                let label = finding.candidate.label();
                table.row(vec![label.into(), e.name.into(), Short(e.value).to_string().into(), interval.into(), e.unit.into()]);
            }
        }
        table
    }

    fn error_table(&self) -> Table {
        let head: Vec<&str> = std::iter::once("model").chain(DIMENSION_KEYS).chain(["position mean [m]", "position at K [m]"]).collect();
        let mut table = Table::new("Mean absolute error over the horizon on held-out drives", &head);
        for (name, tree) in self.stages() {
            let numbers = tree.mae_mean.to_array().into_iter().chain([tree.position_m.mean, tree.position_m.final_]);
            let cells = numbers.map(|v| v.map_or("-".to_string(), |v| format!("{v:.3}")).into());
            table.row(std::iter::once(name.into()).chain(cells).collect());
        }
        table
    }

    /// Name and errors of each control.
    pub fn control_errors(&self) -> Vec<(String, &ErrorTree<f64>)> {
        self.control_scores()
            .map(|(kind, parameters, score)| (format!("{} ({parameters})", control_name(&kind)), &score.summary.tree))
            .collect()
    }

    /// Name and errors of before, soil only, after.
    pub fn stages(&self) -> Vec<(&'static str, &ErrorTree<f64>)> {
        self.diagnosis.scores.iter().flat_map(|s| STAGES.into_iter().zip(s.scores.iter().map(|m| &m.summary.tree))).collect()
    }

    /// What the effect gains over the unchanged bundle and over the best soil alone: reduction of each error with its 95 % interval, positive = better.
    pub fn gains(&self) -> Vec<(&'static str, ErrorTree<f64>, ErrorTree<[f64; 2]>)> {
        let Some(s) = &self.diagnosis.scores else { return Vec::new() };
        let against = |i: usize, name| {
            let (gain, interval) = paired_difference(&s.scores[i].errors, &s.scores[2].errors, &s.resamples);
            (name, gain, interval)
        };
        vec![against(0, "gain over before"), against(1, "gain over soil only")]
    }

    fn curve(&self, scores: &crate::HeldOut, dimension: usize) -> LinePlot {
        let title = DIMENSION_KEYS.get(dimension).copied().unwrap_or("position_m");
        let mut plot = LinePlot::new(title, "time ahead [s]", title);
        plot.from_zero = true;
        for (i, (name, model)) in STAGES.into_iter().zip(&scores.scores).enumerate() {
            let Some(curve) = &model.curves[dimension] else { continue };
            let time = |k: usize| (k + 1) as f64 * self.dt_s;
            let mut series = Series::line(name, i + 1, curve.mean.iter().enumerate().map(|(k, v)| (time(k), *v)).collect());
            series.band = curve.ci95.iter().enumerate().map(|(k, [l, h])| (time(k), *l, *h)).collect();
            plot.series.push(series);
        }
        plot
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// A control in words.
pub fn control_name(kind: &Kind) -> String {
    match kind {
        Kind::Placebo(candidate) => format!("placebo: {}", candidate.label()),
        Kind::Rival(candidate) => format!("rival: {}", candidate.label()),
        Kind::BlackBox => "black box".into(),
        Kind::FreeForm => "with free form".into(),
    }
}

fn control_json(kind: Kind, parameters: usize, score: &ModelScore) -> Value {
    let mut tree = json!(score.summary);
    if let Some(map) = tree.as_object_mut() {
        map.insert("parameters".into(), json!(parameters));
        if let Kind::Placebo(candidate) | Kind::Rival(candidate) = kind {
            map.insert("id".into(), json!(candidate.id()));
            return of_wheel(tree, candidate);
        }
    }
    tree
}

fn trace_plot(trace: &Trace) -> LinePlot {
    let name = channels::name(trace.channel);
    let mut plot = LinePlot::new(&format!("{}: {name}", channels::layer(trace.channel)), "time in the drive [s]", &name);
    plot.series.push(Series::line("before", 1, trace.before.clone()));
    if trace.after != trace.before {
        plot.series.push(Series::line("with the effects", 3, trace.after.clone()));
    }
    plot
}

/// What to drive so that each effect that was found and its closest rival come apart, in words.
pub fn to_tell_apart(found: &Diagnosis) -> impl Iterator<Item = String> {
    named(found).filter_map(|finding| {
        let (rival, manoeuvre) = (finding.rivals.first()?, manoeuvre::separating(finding)?);
        Some(format!("to tell {} from {}: {manoeuvre}", finding.candidate.label(), rival.candidate.label()))
    })
}

/// Findings that were not refused.
fn named(found: &Diagnosis) -> impl Iterator<Item = &Finding> {
    found.findings.iter().filter(|finding| finding.refused.is_none())
}

/// An effect in words.
pub fn describe(finding: &Finding) -> String {
    let parameters: Vec<String> = finding.estimates.iter().map(|p| format!("{} {}", p.name, Short(p.value))).collect();
    let onset = match (finding.onset, finding.may_have_begun_s) {
        (Some(onset), _) => format!(" from {:.1} s on", onset.at_s),
        (None, Some(at_s)) => format!(" (it may have begun at about {at_s:.1} s, and be another size then)"),
        (None, None) => String::new(),
    };
    parameters.join(", ") + &onset
}

/// A parameter; one of a wheel is a whole number that was chosen, not measured.
fn estimate_json(e: &Estimate) -> Value {
    let chosen = e.value as i64;
    match e.ci95 {
        None if e.unit == "index" => json!({"name": e.name, "unit": e.unit, "value": chosen, "ci95": [chosen, chosen]}),
        ci95 => json!({"name": e.name, "unit": e.unit, "value": e.value, "ci95": ci95}),
    }
}

/// With the wheel of a hypothesis that has one.
fn of_wheel(mut tree: Value, candidate: Candidate) -> Value {
    if let (Some(map), Some(wheel)) = (tree.as_object_mut(), candidate.wheel()) {
        map.insert("wheel".into(), json!(wheel));
    }
    tree
}

fn effect_json(finding: &Finding) -> Value {
    let parameters: Vec<Value> = finding.estimates.iter().map(estimate_json).collect();
    let rivals: Vec<Value> =
        finding.rivals.iter().map(|r| of_wheel(json!({"id": r.candidate.id(), "weight": r.weight}), r.candidate)).collect();
    json!({
        "id": finding.candidate.id(),
        "weight": finding.weight,
        "layer": layer_name(finding.candidate.layer()),
        "parameters": parameters,
        "onset_s": finding.onset.map(|o| o.at_s),
        "onset_ci95": finding.onset.map(|o| o.ci95_s),
        "onset_possible_s": finding.may_have_begun_s,
        "evidence": {"z": finding.z, "z_after_others": finding.alone, "delta_bic": finding.delta_bic, "stability": finding.stability},
        "rivals": rivals,
        "separating_manoeuvre": manoeuvre::separating(finding),
    })
}

fn layer_name(layer: Layer) -> String {
    layer.as_str().into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::claims::Member;
    use crate::judgement::Verdict;
    use crate::select::Selection;

    /// Goal: readers find every key of the errors where no drive was held out. Method: a diagnosis without scores.
    #[test]
    fn property_errors_without_held_out_drives_have_keys_and_no_numbers() {
        let diagnosis = Diagnosis {
            verdict: Verdict::None,
            reason: "nothing stands out".into(),
            catalogue: Vec::new(),
            channels: Vec::new(),
            left_out: Vec::new(),
            unseen: Vec::new(),
            levels: Vec::new(),
            traces: Vec::new(),
            controls: Vec::new(),
            free_form: None,
            null_drives: None,
            selection: Selection::empty(4.0),
            findings: Vec::new(),
            estimates: Vec::new(),
            claimed: Vec::new(),
            soils: None,
            fit_on: vec!["the only one".into()],
            held_out: Vec::new(),
            learned: Vec::new(),
            scores: None,
        };
        let provenance = Provenance::default();
        let report = Report {
            set: "alone",
            diagnosis: &diagnosis,
            bundle: None,
            free_form_bundle: None,
            provenance: &provenance,
            dt_s: 0.1,
            against: Against::Bundle,
            doubts: &["yaw counts like a compass".into()],
            notes: &["pieces of one recording".into()],
        };
        let json: Value = serde_json::from_str(&report.to_json()).unwrap();
        let without_numbers = json!(ErrorSummary::default());
        assert_eq!(json["doubts"][0], "yaw counts like a compass");
        assert!(report.to_html().contains("<p>yaw counts like a compass</p>"));
        assert!(json["notes"][0] == "pieces of one recording" && report.to_html().contains("<p>pieces of one recording</p>"));
        assert_eq!(without_numbers["windows"], 0);
        for errors in [&json["before"], &json["soil_only"], &json["after"], &json["controls"]["black_box_refit"]] {
            assert_eq!(errors, &without_numbers);
        }
        for gain in ["improvement", "improvement_ci95"] {
            assert!(json[gain]["position_m"].is_object() && json[gain]["position_m"]["mean"].is_null(), "{}", json[gain]);
        }
    }

    /// Goal: the wheel that drags is a whole number with an interval, and hypotheses of one wheel say which wherever they are named. Method: a drag of the rear left wheel as an
    /// effect, as a rival and as a control.
    #[test]
    fn property_a_wheel_is_a_whole_number_wherever_it_is_named() {
        let catalogue = crate::candidates::catalogue(&[]);
        let drag = *catalogue.iter().find(|c| c.label() == "wheel_drag RL").unwrap();
        let estimates = [("wheel", "index", 2.0, None), ("torque_nm", "N m", 900.0, Some([800.0, 1000.0]))];
        let estimates = estimates.map(|(name, unit, value, ci95)| Estimate { name, unit, value, ci95 }).to_vec();
        let mut finding = Finding::of(&catalogue, "wheel_drag", 9.0, estimates);
        let tow = Finding::of(&catalogue, "tow", 9.0, Vec::new()).candidate;
        finding.rivals = [tow, drag].map(|candidate| Member { candidate, weight: 0.25 }).to_vec();
        let json = effect_json(&finding);
        assert_eq!(json["parameters"][0], json!({"name": "wheel", "unit": "index", "value": 2, "ci95": [2, 2]}));
        assert_eq!(json["parameters"][1]["ci95"], json!([800.0, 1000.0]));
        assert_eq!((json["rivals"][0].get("wheel"), &json["rivals"][1]["wheel"]), (None, &json!(2)));
        let score = crate::proof::tests::score([0.1; POSE_DIM]);
        let control = control_json(Kind::Placebo(drag), 1, &score);
        assert_eq!((&control["id"], &control["wheel"]), (&json!("wheel_drag"), &json!(2)));
    }
}
