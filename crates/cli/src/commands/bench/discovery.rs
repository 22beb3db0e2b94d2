//! `nesam bench discovery`: how often a diagnosis is right on drives with hidden effects.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::Args;
use clap::builder::PossibleValuesParser;
use nesam_discovery::bench::{Hidden, METHODS, MethodScores, Outcome, Scores, Stage, method_scores, plan, scores};
use nesam_discovery::{Judge, Scoring};
use nesam_evaluation::report::Short;
use serde_json::json;

use crate::args::{BundleArgs, DataArgs, SplitArg, check_count};
use crate::failure::{Failure, OrFail};
use crate::interrupt::exit_on_ctrl_c;
use crate::output::{check_file, provenance, say, write_json};
use crate::progress::Progress;
use crate::sources::{load_bundle_for, predictor_for, validation_drives};

/// Rollouts by which methods are compared.
const SCORING: Scoring = Scoring { horizon: 32, history: 32, resamples: 10, seed: 1 };

/// Options of `nesam bench discovery`.
#[derive(Args, Debug)]
pub(super) struct DiscoveryBench {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    bundle: BundleArgs,
    /// Sets of the benchmark [default: all]
    #[arg(long, value_name = "NAME,…", value_delimiter = ',', value_parser = PossibleValuesParser::new(names_of_sets()))]
    sets: Vec<String>,
    /// Pseudo-vehicles of five validation drives for each hidden effect; at most as many as the drives make
    #[arg(long, default_value_t = 1)]
    groups: usize,
    /// Take only every n-th hidden effect
    #[arg(long, value_name = "N", default_value_t = 1)]
    every_hidden: usize,
    /// Groups without an effect for each null set; the first are disjoint, further ones are drawn at random and overlap [default: the disjoint ones]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    nulls: usize,
    /// Let other methods try too: the refitted true effect, soil alone, ridge and STLSQ over the whole catalogue, a black box, a free form
    #[arg(long)]
    comparators: bool,
    /// Write the figures as JSON (schema nesam.bench.discovery/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Names of the sets of the benchmark, each once, in their order.
fn names_of_sets() -> Vec<&'static str> {
    let mut names: Vec<&str> = Vec::new();
    for hidden in plan() {
        if !names.contains(&hidden.set) {
            names.push(hidden.set);
        }
    }
    names
}

/// Runs the command.
pub(super) fn run(args: &DiscoveryBench) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| check_file(file))?;
    exit_on_ctrl_c("nothing was written");
    let mut data = args.data.clone();
    if data.split == SplitArg::All {
        // Only drives of the train split are left for validation.
        data.split = SplitArg::Train;
    }
    let drives = validation_drives(&data, "bench discovery", "effects are hidden")?;
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
    let judge = Judge::of(predictor.bundle()).or_input()?;
    let known = judge.drives();
    if drives.drives.iter().any(|d| !known.contains(&d.id)) || drives.drives.len() != known.len() {
        let reason = "these validation drives are not those of the bundle's reference; run `nesam diagnose --make-reference` on them";
        return Err(Failure::input(reason.to_string()));
    }
    let stage = Stage { predictor: &predictor, judge: &judge, drives: &drives.drives, maps: &drives.maps };
    let runs = chosen(args, stage.groups())?;
    let progress = Progress::start("pseudo-vehicles", runs.len());
    let mut outcomes = Vec::new();
    for (done, (hidden, group)) in runs.iter().enumerate() {
        outcomes.push(stage.run(hidden, *group, args.comparators.then_some(&SCORING)).or_failed()?);
        progress.set(done + 1);
    }
    progress.finish();
    let mut sets: BTreeMap<&str, Vec<&Outcome>> = BTreeMap::new();
    for outcome in &outcomes {
        sets.entry(outcome.set).or_default().push(outcome);
    }
    let compared: Vec<&str> = METHODS.into_iter().filter(|_| args.comparators).collect();
    let comparators: BTreeMap<&str, BTreeMap<&str, MethodScores>> =
        compared.iter().map(|m| (*m, sets.iter().map(|(name, runs)| (*name, method_scores(runs, m))).collect())).collect();
    let sets: BTreeMap<&str, Scores> = sets.into_iter().map(|(name, runs)| (name, scores(&runs))).collect();
    print(&outcomes, &sets);
    if args.comparators {
        print_comparators(&comparators);
    }
    let Some(file) = &args.json else { return Ok(()) };
    let document = json!({
        "schema": "nesam.bench.discovery/1",
        "sets": sets,
        "comparators": comparators,
        "runs": outcomes,
        "provenance": provenance(Some(predictor.bundle()), &drives),
    });
    write_json(file, &document)
}

/// What is run: hidden effects with their group of drives. Without effects every group is tried once, because there are so few.
fn chosen(args: &DiscoveryBench, groups: usize) -> Result<Vec<(Hidden, usize)>, Failure> {
    check_count("--every-hidden", args.every_hidden, 1..=usize::MAX)?;
    if groups == 0 {
        return Err(Failure::input("bench discovery needs at least five validation drives"));
    }
    let plan = plan();
    let wanted = |h: &Hidden| args.sets.is_empty() || args.sets.iter().any(|s| s == h.set);
    // Its place in the whole plan chooses the drives of an effect, so that the choice of sets does not.
    let (nulls, effects): (Vec<_>, Vec<_>) =
        plan.into_iter().enumerate().filter(|(_, h)| wanted(h)).partition(|(_, h)| h.set.starts_with("null"));
    let effects = effects.into_iter().step_by(args.every_hidden);
    let mut runs: Vec<(Hidden, usize)> =
        effects.flat_map(|(i, h)| (0..args.groups.min(groups)).map(move |g| (h.clone(), (i + g) % groups))).collect();
    let count = if args.nulls == 0 { groups } else { args.nulls };
    runs.extend(nulls.into_iter().flat_map(|(_, h)| (0..count).map(move |g| (h.clone(), g))));
    Ok(runs)
}

/// Share of the oracle's gain, ratio of errors, and what is named, by method and set.
fn print_comparators(comparators: &BTreeMap<&str, BTreeMap<&str, MethodScores>>) {
    say!("\n{:<12}{:<12}{:>6}{:>17}{:>13}{:>7}{:>13}", "method", "set", "runs", "share of oracle", "error ratio", "top-1", "false alarm");
    let show = |v: Option<f64>| v.map_or("–".to_string(), |v| format!("{v:.2}"));
    for (method, sets) in comparators {
        for (set, s) in sets {
            say!(
                "{method:<12}{set:<12}{:>6}{:>17}{:>13}{:>7}{:>13}",
                s.runs,
                show(s.share_of_oracle),
                show(s.error_ratio),
                show(s.top1),
                show(s.false_alarm)
            );
        }
    }
}

fn print(outcomes: &[Outcome], sets: &BTreeMap<&str, Scores>) {
    for o in outcomes {
        let truth: Vec<String> = o.truth.iter().map(|(id, size)| format!("{id} {size}")).collect();
        let claims: Vec<String> = o
            .claims
            .iter()
            .map(|c| {
                let values: Vec<String> = c
                    .parameters
                    .iter()
                    .map(|(name, v, ci)| {
                        ci.map_or(format!("{name} {v}"), |[l, h]| format!("{name} {} [{}, {}]", Short(*v), Short(l), Short(h)))
                    })
                    .collect();
                let onset = c.onset_s.map_or(String::new(), |t| format!(" from {t:.1} s"));
                let rivals = if c.rivals.is_empty() { String::new() } else { format!(" or {}", c.rivals.join(" or ")) };
                format!("{}{rivals}: {}{onset}", c.id, values.join(", "))
            })
            .collect();
        say!(
            "{:<11} {:<38} {:<12} z {:5.1} of {:.1}  {}  ({:.0} s){}",
            o.set,
            truth.join(" + "),
            o.verdict,
            o.evidence[0],
            o.evidence[1],
            claims.join("; "),
            o.seconds,
            if o.claims.is_empty() { format!("  {}", o.reason) } else { String::new() }
        );
    }
    say!(
        "\n{:<12}{:>5}{:>7}{:>7}{:>9}{:>6}{:>8}{:>8}{:>13}{:>10}{:>9}{:>8}",
        "set",
        "runs",
        "top-1",
        "class",
        "coverage",
        "size",
        "alarm",
        "wrong",
        "unexplained",
        "size err",
        "CI cov",
        "onset"
    );
    let show = |v: Option<f64>| v.map_or("–".to_string(), |v| format!("{v:.2}"));
    for (name, s) in sets {
        say!(
            "{name:<12}{:>5}{:>7}{:>7}{:>9}{:>6}{:>8}{:>8}{:>13}{:>10}{:>9}{:>8}",
            s.runs,
            show(s.top1),
            show(s.class_accuracy),
            show(s.set_coverage),
            show(s.set_size),
            show(s.false_alarm),
            show(Some(s.wrong_claim)),
            show(Some(s.unexplained)),
            show(s.magnitude_error_median),
            show(s.ci_coverage),
            show(s.onset_error_median_s)
        );
        if let (Some(rate), Some([low, high])) = (s.false_alarm, s.false_alarm_ci95) {
            say!("{:<12}false alarms {rate:.3} of {} runs, 95 % interval as if they were independent [{low:.3}, {high:.3}]", "", s.runs);
        }
    }
}
