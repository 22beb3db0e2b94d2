//! What `nesam diagnose` prints of a diagnosis.

use nesam_discovery::observe::channels;
use nesam_discovery::report::{Report, describe, to_tell_apart};
use nesam_discovery::{Against, Diagnosis};
use nesam_evaluation::POSE_DIM;
use nesam_evaluation::report::Short;

use crate::output::{error_heads, say};

/// Hypotheses in the printed table.
const SHOWN: usize = 12;
/// Channels whose levels stand out that are printed, loudest first.
const SHOWN_LEVELS: usize = 3;

/// Where the bundles are that have what was found.
pub(super) fn bundles(report: &Report<'_>) {
    let told = [(report.bundle, "what is claimed"), (report.free_form_bundle, "what is claimed and the free form of what is left")];
    for (bundle, what) in told.into_iter().filter_map(|(bundle, what)| Some((bundle?, what))) {
        say!("bundle with {what}: {bundle}");
    }
    let another_ground = report.diagnosis.soils.is_some_and(|soils| soils.alone != soils.assumed);
    if report.bundle.is_none() && another_ground && matches!(report.against, Against::Physics) {
        say!(
            "what to do: `nesam calibrate` with --bundle fits the card on the ground that the drives tell of; then diagnose with the bundle that it writes"
        );
    }
}

/// The verdict, what stands out, what was chosen, and errors before and after.
pub(super) fn summary(report: &Report<'_>, found: &Diagnosis) {
    say!("{}: {} - {}", report.set, found.verdict.as_str().to_uppercase(), found.reason);
    report.left_out().iter().for_each(|left_out| say!("{left_out}"));
    report.doubts.iter().for_each(|doubt| say!("doubt: {doubt} (`nesam check` tells more; a claim may be wrong by it)"));
    evidence(report.against, found);
    findings(found);
    if report.stages().is_empty() {
        return;
    }
    errors(report, found);
    if !found.claimed.is_empty() {
        gains(report);
    }
}

/// What stands out most, of the catalogue and of what has no cause by itself.
fn evidence(against: Against, found: &Diagnosis) {
    let s = &found.selection;
    let p = s.probability.map_or(String::new(), |[p, least]| format!("; family-wise p = {p:.4} (smallest that can be shown {least:.4})"));
    say!(
        "\nevidence against {} (threshold z = {:.2}{p})",
        match against {
            Against::Bundle => "drives without an effect",
            Against::Physics => "random signs of the drives",
        },
        s.threshold
    );
    let mut order: Vec<usize> = (0..found.catalogue.len()).filter(|e| s.z[*e].is_some()).collect();
    order.sort_by(|a, b| s.z[*b].unwrap_or(0.0).total_cmp(&s.z[*a].unwrap_or(0.0)));
    for e in order.into_iter().take(SHOWN) {
        say!("  {:<24} z {:7.1}", found.catalogue[e].label(), s.z[e].unwrap_or(0.0));
    }
    let levels = found.levels_seen().into_iter().map(|(z, channel)| (z, channels::level_name(channel)));
    let bends = found.bends_seen().into_iter().map(|(z, bend)| (z, bend.name()));
    for mut evidence in [levels.collect::<Vec<_>>(), bends.collect()] {
        evidence.sort_by(|a, b| b.0.total_cmp(&a.0));
        for (z, what) in evidence.into_iter().take_while(|(z, _)| *z >= s.threshold).take(SHOWN_LEVELS) {
            say!("  {what:<24} z {z:7.1}");
        }
    }
}

/// What was chosen, with sizes and rivals, and what is left.
fn findings(found: &Diagnosis) {
    for f in &found.findings {
        let rivals: Vec<String> = f.rivals.iter().map(|r| format!("{} ({:.2})", r.candidate.label(), r.weight)).collect();
        let rivals = if rivals.is_empty() { String::new() } else { format!("; rivals {}", rivals.join(", ")) };
        let refused = f.refused.as_ref().map_or(String::new(), |why| format!("; refused: {why}"));
        say!(
            "{}: z {:.1} after the others, criterion {:+.1}, stability {:.2}; {}{rivals}{refused}",
            f.candidate.label(),
            f.alone,
            f.delta_bic,
            f.stability,
            describe(f)
        );
        for e in &f.estimates {
            let interval = e.ci95.map_or(String::new(), |[low, high]| format!("[{}, {}] ", Short(low), Short(high)));
            say!("  {} = {} {interval}{}", e.name, Short(e.value), e.unit);
        }
    }
    to_tell_apart(found).for_each(|apart| say!("{apart}"));
    let (z, what) = &found.selection.remaining;
    let place = if what.is_empty() { String::new() } else { format!(" in {what}") };
    say!("{}: z = {z:.1}{place}", if found.selection.chosen.is_empty() { "the most that stands out" } else { "left after that" });
}

/// Errors on drives that were not fitted, a row for each stage and control.
fn errors(report: &Report<'_>, found: &Diagnosis) {
    say!("\n{:<28}{}{:>9}", "drives not fitted", error_heads(9), "final m");
    let stages = report.stages().into_iter().map(|(name, tree)| (name.to_string(), tree));
    for (name, tree) in stages.chain(report.control_errors()) {
        let numbers: [Option<f64>; POSE_DIM] = tree.mae_mean.to_array();
        let cells: String = numbers
            .iter()
            .chain([&tree.position_m.mean, &tree.position_m.final_])
            .map(|v| v.map_or("        –".into(), |v| format!("{v:9.3}")))
            .collect();
        say!("{name:<28}{cells}");
    }
    if let Some(n) = &found.null_drives {
        let helped = n.null.iter().filter(|g| **g > 0.0).count();
        say!("the same effects on {} drives without one: they would help {helped}", n.null.len());
    }
}

/// What the claim gains, with intervals.
fn gains(report: &Report<'_>) {
    for (name, gain, interval) in report.gains() {
        let numbers = gain.mae_mean.to_array().into_iter().chain([gain.position_m.mean, gain.position_m.final_]);
        let ends = interval.mae_mean.to_array().into_iter().chain([interval.position_m.mean, interval.position_m.final_]);
        let cells: Vec<String> = numbers
            .zip(ends)
            .map(|(g, i)| match (g, i) {
                (Some(g), Some([low, high])) => format!("{g:+.3} [{low:+.3}, {high:+.3}]"),
                _ => "–".into(),
            })
            .collect();
        say!("{name:<22}{}", cells.join("  "));
    }
}
