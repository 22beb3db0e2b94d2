//! Recorded drives over a bad link: what that costs, and what the service says of it.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use nesam_degradation::{Degradation, Passage, RowSummary, Setup, Verdict, degraded, drive_through, summarise};
use nesam_evaluation::{DEFAULT_RESAMPLES, Resamples, Truth};
use nesam_model::MAX_HORIZON;
use nesam_trajectories::windows;
use rayon::prelude::*;
use serde_json::json;

use super::ReplayArgs;
use crate::args::{check_count, longest_horizon};
use crate::failure::{Failure, OrFail};
use crate::interrupt;
use crate::output::{self, say};
use crate::progress::Progress;
use crate::sources::{Drives, load_bundle_for, predictor_for, read_drives};

/// Runs the command on recorded drives.
pub fn run(args: &ReplayArgs) -> Result<(), Failure> {
    let specs = args.degrade.iter().map(|text| Degradation::parse(text).or_input()).collect::<Result<Vec<_>, _>>()?;
    interrupt::exit_on_ctrl_c("nothing was written");
    let truth = Truth::from(args.truth);
    args.horizon.map_or(Ok(()), |horizon| check_count("--horizon", horizon, 1..=MAX_HORIZON))?;
    let mut drives = read_drives(&args.data, truth == Truth::Gt)?;
    every_nth(&mut drives, args.every.get());
    let longest = drives.drives.iter().map(|drive| drive.states.len()).max().unwrap_or(0);
    let horizon = args.horizon.unwrap_or_else(|| longest_horizon(&drives.drives));
    let asked: Vec<Vec<usize>> = drives.drives.iter().map(|drive| windows(drive.states.len(), horizon, MAX_HORIZON)).collect();
    if asked.iter().all(Vec::is_empty) {
        return Err(Failure::input(format!("--horizon {horizon} does not fit: the longest drive has {longest} samples")));
    }
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
    let setup = Setup { predictor: Arc::clone(&predictor), horizon, truth };
    let resamples = Resamples::draw(drives.drives.len(), DEFAULT_RESAMPLES, args.seed);
    let clean = passages(&setup, &drives, &asked, &Degradation::default(), args.seed)?;
    let mut rows = vec![summarise("none", &drives.drives, &clean, &clean, horizon, &resamples)];
    for spec in &specs {
        let passages = passages(&setup, &drives, &asked, spec, args.seed)?;
        rows.push(summarise(&spec.to_string(), &drives.drives, &passages, &clean, horizon, &resamples));
    }
    print(args, &drives, horizon, &rows);
    if let Some(file) = &args.json {
        let document = json!({
            "schema": "nesam.degrade/1",
            "set": drives.set,
            "split": args.data.split.as_str(),
            "drives": drives.drives.len(),
            "every": args.every,
            "horizon_steps": horizon,
            "truth": truth.as_str(),
            "seed": args.seed,
            "rows": rows,
            "provenance": output::provenance(Some(predictor.bundle()), &drives),
        });
        output::write_json(file, &document)?;
    }
    Ok(())
}

/// Keeps every n-th drive by name.
fn every_nth(drives: &mut Drives, every: usize) {
    let mut all: Vec<_> = std::mem::take(&mut drives.drives).into_iter().zip(std::mem::take(&mut drives.maps)).collect();
    all.sort_by(|(a, _), (b, _)| a.id.cmp(&b.id));
    (drives.drives, drives.maps) = all.into_iter().step_by(every).unzip();
}

/// Every drive through an engine of its own, on all cores; drives of one world together, as a predictor keeps few maps.
fn passages(setup: &Setup, drives: &Drives, asked: &[Vec<usize>], spec: &Degradation, seed: u64) -> Result<Vec<Passage>, Failure> {
    let progress = Progress::start(&format!("drives, {spec}"), drives.drives.len());
    let done = AtomicUsize::new(0);
    let mut order: Vec<usize> = (0..drives.drives.len()).collect();
    order.sort_by_key(|&i| drives.maps[i].as_ref().map(|map| map.hash()));
    let mut passed = order
        .par_iter()
        .map(|&i| {
            let link = degraded(&drives.drives[i], spec, seed);
            let passage = drive_through(setup, &drives.drives[i], drives.maps[i].as_ref(), &link, &asked[i]).or_failed()?;
            progress.set(done.fetch_add(1, Ordering::Relaxed) + 1);
            Ok((i, passage))
        })
        .collect::<Result<Vec<_>, Failure>>()?;
    progress.finish();
    passed.sort_by_key(|(i, _)| *i);
    Ok(passed.into_iter().map(|(_, passage)| passage).collect())
}

fn print(args: &ReplayArgs, drives: &Drives, horizon: usize, rows: &[RowSummary]) {
    say!(
        "{} ({}): {} drives, {} windows of {horizon} steps, seed {}; mean errors over the horizon, ratio to the clean drives at the same windows",
        drives.set,
        args.data.split.as_str(),
        drives.drives.len(),
        rows[0].windows,
        args.seed
    );
    let number = |value: Option<f64>, digits: usize| value.map_or("–".into(), |v| format!("{v:.digits$}"));
    let with = |(value, interval): (Option<f64>, Option<[f64; 2]>)| {
        format!("{}{}", number(value, 3), interval.map_or(String::new(), |[low, high]| format!(" [{low:.3}, {high:.3}]")))
    };
    for row in rows {
        say!("\n{}", row.degradation);
        let tree = &row.degraded.tree;
        let interval = row.degraded.ci95.position_m.mean.map_or(String::new(), |[low, high]| format!(" [{low:.3}, {high:.3}]"));
        say!("  position {} m{interval}, yaw {}°", number(tree.position_m.mean, 3), number(tree.mae_mean.yaw_deg, 2));
        say!("  ratio    position {}, yaw {}", with(row.position_ratio), with(row.yaw_ratio));
        let (unanswered, windows) = (row.unanswered, row.windows);
        let (age, history) = (number(row.age_s_mean, 3), number(row.history_steps_mean, 1));
        say!("  asked    {windows} windows, {unanswered} without answer; start {age} s old, {history} steps of history");
        let answers: Vec<String> = row.answers.iter().map(|(label, count)| format!("{count} {label}")).collect();
        say!("  link     {} sent, {} arrived: {}", row.sent, row.arrived, answers.join(", "));
        let s = &row.soil;
        let verdict = match s.verdict {
            Verdict::Consistent => "consistent",
            Verdict::Inconsistent => "NOT CONSISTENT",
            Verdict::NotLearned => "nothing learned",
        };
        let (mean, median) = (number(s.nis_mean_over_dof, 2), number(s.nis_median_over_dof, 2));
        say!("  soil     {verdict}: {} buffers, {} refused, NIS/dof mean {mean} median {median}", s.buffers, s.rejected);
        let (yes, no, none) = (s.drives_consistent, s.drives_inconsistent, s.drives_not_learned);
        let share = number(s.predictions_not_learned, 2);
        say!("           drives: {yes} consistent, {no} not, {none} without soil; share of predictions that say so: {share}");
    }
}
