//! The JSON (`nesam.diagnose/1`) and the HTML page of a diagnosis.

use nesam_evaluation::report::{LinePlot, Page, Series, Table};
use nesam_evaluation::{DIMENSION_KEYS, ErrorTree, POSE_DIM, Provenance, paired_difference};
use serde_json::{Value, json};

use crate::candidates::Candidate;
use crate::diagnose::{Diagnosis, StatisticDeviation, Verdict};
use crate::features;
use crate::select::Ranked;

/// Version of the rule by which a diagnosis stops.
pub const STOP_RULE: &str = "1: one effect";
const STAGES: [&str; 3] = ["before", "soil only", "after"];
const MEMBERS_MAX: usize = 3;

/// What a report is made from.
#[derive(Clone, Copy, Debug)]
pub struct Report<'a> {
    /// Name of the set.
    pub set: &'a str,
    /// Findings.
    pub diagnosis: &'a Diagnosis,
    /// Folder of the patched bundle, where one was written.
    pub bundle: Option<&'a str>,
    /// What it was computed from.
    pub provenance: &'a Provenance,
    /// Step of the model, s.
    pub dt_s: f64,
}

impl Report<'_> {
    /// The JSON document.
    pub fn to_json(&self) -> String {
        let d = self.diagnosis;
        let stage = |i: usize| d.scores.as_ref().map(|s| &s.scores[i].summary);
        let improvement = d.scores.as_ref().map(|s| {
            let (difference, interval) = paired_difference(&s.scores[1].errors, &s.scores[2].errors, &s.resamples);
            (json!(difference), json!(interval))
        });
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
            "improvement_ci95": improvement.as_ref().map(|(_, i)| i),
            "controls": {"black_box_refit": null, "placebo_rival": null, "before_onset": null, "free_form": null},
            "attainable_p": d.selection.probability.map(|[_, attainable]| attainable),
            "bundle": self.bundle,
            "reason": d.reason,
            "improvement": improvement.as_ref().map(|(m, _)| m),
            "p_family_wise": d.selection.probability.map(|[p, _]| p),
            "threshold_z": d.selection.threshold,
            "distance_per_statistic": d.selection.distance[0],
            "soil_bic_against_none": d.selection.soil_bic,
            "considered": self.considered(),
            "learned_per_held_out_drive": self.learned(),
            "stop_rule": STOP_RULE,
            "provenance": self.provenance,
        });
        let map = document.as_object_mut().expect("an object was built; this is a bug");
        let names = features::names();
        let statistic = |c: &StatisticDeviation| json!({"statistic": names[c.statistic], "layer": features::layer(c.statistic), "difference": c.difference, "significance": c.significance});
        map.insert("statistics".into(), d.statistics.iter().map(statistic).collect());
        serde_json::to_string_pretty(&document).expect("finite numbers and text always serialise; this is a bug") + "\n"
    }

    /// The claimed effect with its rivals: an equivalence class of at most three, weights of which sum to 1.
    fn effects(&self) -> Vec<Value> {
        let d = self.diagnosis;
        if !matches!(d.verdict, Verdict::Explained | Verdict::Ambiguous) {
            return Vec::new();
        }
        let class: Vec<&Ranked> = d.selection.ranked.iter().filter(|r| r.refused.is_none()).take(MEMBERS_MAX).collect();
        let total: f64 = class.iter().map(|r| r.weight).sum();
        let Some((best, rivals)) = class.split_first() else { return Vec::new() };
        let next = d.selection.ranked.iter().skip(1).find(|r| r.candidate.id() != best.candidate.id()).map_or(0.0, |r| r.bic.min(0.0));
        let parameters: Vec<Value> =
            d.estimates.iter().map(|e| json!({"name": e.name, "unit": e.unit, "value": e.value, "ci95": e.ci95})).collect();
        let rivals: Vec<Value> = rivals
            .iter()
            .map(|r| {
                let parameters: Vec<Value> =
                    r.effect().parameters().iter().map(|p| json!({"name": p.name, "unit": p.unit, "value": p.value})).collect();
                json!({"id": r.candidate.id(), "weight": r.weight / total, "parameters": parameters})
            })
            .collect();
        let e = Candidate::ALL.iter().position(|c| *c == best.candidate).unwrap_or(0);
        vec![json!({
            "id": best.candidate.id(),
            "weight": best.weight / total,
            "layer": format!("{:?}", best.effect().layer()).to_lowercase(),
            "parameters": parameters,
            "onset_s": null,
            "onset_ci95": null,
            "evidence": {"z": d.selection.z[e], "delta_bic": next - best.bic, "stability": d.stability},
            "rivals": rivals,
            "separating_manoeuvre": null,
        })]
    }

    fn considered(&self) -> Vec<Value> {
        let s = &self.diagnosis.selection;
        Candidate::ALL
            .iter()
            .enumerate()
            .map(|(e, c)| {
                let ranked = s.ranked.iter().find(|r| r.candidate == *c);
                let parameters =
                    ranked.map(|r| r.effect().parameters().iter().map(|p| json!({"name": p.name, "value": p.value})).collect::<Vec<_>>());
                json!({"hypothesis": c.label(), "z": s.z[e], "bic_against_none": ranked.map(|r| r.bic), "weight": ranked.map(|r| r.weight),
                    "parameters": parameters, "refused": ranked.and_then(|r| r.refused.clone())})
            })
            .collect()
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
                    .map(|e| json!({"id": e.id(), "values": e.parameters().iter().map(|p| p.value).collect::<Vec<_>>()}))
                    .collect();
                json!({"trajectory": id, "effects": effects, "soil_correction": l.soil.delta})
            })
            .collect()
    }

    /// The page.
    pub fn to_html(&self) -> String {
        let d = self.diagnosis;
        let lead = format!(
            "Verdict on set {}: {} - {}. Fitted on {} drives, scored on {} that were not fitted.",
            self.set,
            d.verdict.as_str(),
            d.reason,
            d.fit_on.len(),
            d.held_out.len()
        );
        let mut page = Page::new(&format!("nesam diagnose: {}", self.set), &lead);
        page.section("What was seen")
            .text("Statistics of the drives against the frozen reference, by residual layer; significance is against groups of drives without an effect.")
            .table(&self.statistic_table());
        page.section("What was considered")
            .text(&format!(
                "Evidence against the scatter of drives without an effect; below z = {:.2} nothing is claimed.",
                d.selection.threshold
            ))
            .table(&self.hypothesis_table());
        if !d.estimates.is_empty() && matches!(d.verdict, Verdict::Explained | Verdict::Ambiguous) {
            page.section("What was added").table(&self.estimate_table());
        }
        if let Some(scores) = &d.scores {
            page.section("Error before, with soil alone, after").table(&self.error_table());
            let plots: Vec<LinePlot> = (0..=POSE_DIM).rev().map(|c| self.curve(scores, c)).collect();
            page.section("Error over the horizon")
                .plots(&plots, "Mean absolute error after each step on drives that were not fitted; bands are 95 % intervals.");
        }
        let p = self.provenance;
        page.footer("command", &p.command)
            .footer("version", &format!("nesam {}, stop rule {STOP_RULE}", p.version))
            .footer("bundle", &format!("{} {}", p.bundle, p.bundle_hash))
            .footer("data", &p.data_hash);
        page.render()
    }

    fn statistic_table(&self) -> Table {
        let mut table =
            Table::new("Statistics of the drives, largest deviation first", &["statistic", "layer", "difference", "significance"]);
        let names = features::names();
        let mut statistics: Vec<_> = self.diagnosis.statistics.iter().collect();
        statistics.sort_by(|a, b| b.significance.abs().total_cmp(&a.significance.abs()));
        for c in statistics.into_iter().take(12) {
            table.row(vec![
                names[c.statistic].clone().into(),
                features::layer(c.statistic).into(),
                format!("{:+.4}", c.difference).into(),
                format!("{:+.1}", c.significance).into(),
            ]);
        }
        table
    }

    fn hypothesis_table(&self) -> Table {
        let mut table = Table::new("Hypotheses", &["hypothesis", "z", "criterion against none", "weight", "refit", "refused because"]);
        let s = &self.diagnosis.selection;
        for (e, c) in Candidate::ALL.iter().enumerate() {
            let ranked = s.ranked.iter().find(|r| r.candidate == *c);
            let fit = ranked.map_or("-".into(), |r| describe(r));
            table.row(vec![
                c.label().into(),
                s.z[e].map_or("left out".into(), |z| format!("{z:.1}")).into(),
                ranked.map_or("-".into(), |r| format!("{:+.1}", r.bic)).into(),
                ranked.map_or("-".into(), |r| format!("{:.3}", r.weight)).into(),
                fit.into(),
                ranked.and_then(|r| r.refused.clone()).unwrap_or_default().into(),
            ]);
        }
        table
    }

    fn estimate_table(&self) -> Table {
        let mut table = Table::new("Parameters with 95 % intervals", &["parameter", "value", "interval", "unit"]);
        for e in &self.diagnosis.estimates {
            let interval = e.ci95.map_or("-".into(), |[l, h]| format!("[{l:.3}, {h:.3}]"));
            table.row(vec![e.name.into(), format!("{:.3}", e.value).into(), interval.into(), e.unit.into()]);
        }
        table
    }

    fn error_table(&self) -> Table {
        let head: Vec<&str> = std::iter::once("model").chain(DIMENSION_KEYS).chain(["position mean", "position at K"]).collect();
        let mut table = Table::new("Mean absolute error over the horizon on held-out drives", &head);
        for (name, tree) in self.stages() {
            let numbers = tree.mae_mean.to_array().into_iter().chain([tree.position_m.mean, tree.position_m.final_]);
            let cells = numbers.map(|v| v.map_or("-".to_string(), |v| format!("{v:.3}")).into());
            table.row(std::iter::once(name.into()).chain(cells).collect());
        }
        table
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

/// A refit in words.
pub fn describe(ranked: &Ranked) -> String {
    let parameters: Vec<String> = ranked.effect().parameters().iter().map(|p| format!("{} {:.3}", p.name, p.value)).collect();
    parameters.join(", ")
}
