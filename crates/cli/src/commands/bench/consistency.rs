//! `nesam bench consistency`: whether the soil filter knows how wrong it is.

use std::path::PathBuf;

use clap::Args;
use nesam_adaptation::FilterSettings;
use nesam_evaluation::{TwinPlan, TwinReport, run_twins};
use nesam_model::Predictor;
use nesam_physics::SOIL_NAMES;
use serde_json::json;
use std::sync::Arc;

use crate::args::{BundleArgs, check_count};
use crate::commands::adapt::{filter_in_force, settings_file};
use crate::failure::{Failure, OrFail};
use crate::interrupt::exit_on_ctrl_c;
use crate::output::{check_file, provenance_of, say, write_json};
use crate::sources::load_bundle;

/// Options of `nesam bench consistency`.
#[derive(Args, Debug)]
pub(super) struct ConsistencyBench {
    #[command(flatten)]
    bundle: BundleArgs,
    /// Simulated drives
    #[arg(long, default_value_t = 300)]
    runs: usize,
    /// Buffers of each drive, one per second
    #[arg(long, default_value_t = 30)]
    buffers: usize,
    /// Draw new ground before this buffer, which the filter is not told
    #[arg(long, value_name = "BUFFER")]
    border: Option<usize>,
    /// Settings of the soil filter, as for `nesam adapt`
    #[arg(long, value_name = "FILE.json")]
    filter: Option<PathBuf>,
    /// Algorithm 1 of the paper to the letter
    #[arg(long)]
    literal: bool,
    /// Seed of soils, drives and noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write the figures as JSON (schema nesam.bench.consistency/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Runs the command.
pub(super) fn run(args: &ConsistencyBench) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| check_file(file))?;
    check_count("--runs", args.runs, 1..=usize::MAX)?;
    check_count("--buffers", args.buffers, 1..=usize::MAX)?;
    if let Some(border) = args.border {
        check_count("--border", border, 0..=args.buffers - 1)?;
    }
    exit_on_ctrl_c("nothing was written");
    let bundle = load_bundle(args.bundle.bundle.as_deref())?;
    let config = filter_in_force(&settings_file(args.filter.as_deref())?, args.literal, &bundle)?;
    let predictor = Predictor::new(Arc::new(bundle)).or_input()?;
    let plan = TwinPlan { runs: args.runs, buffers: args.buffers, border: args.border, seed: args.seed };
    let report = run_twins(predictor.step_model(), &config, &plan).or_failed()?;
    print_report(&report);
    let Some(file) = &args.json else { return Ok(()) };
    let document = json!({
        "schema": "nesam.bench.consistency/1",
        "plan": { "runs": args.runs, "buffers": args.buffers, "border": args.border, "seed": args.seed, "literal": args.literal },
        "report": report,
        "filter": FilterSettings::of(&config),
        "provenance": provenance_of(Some(predictor.bundle()), "", ""),
    });
    write_json(file, &document)
}

fn print_report(r: &TwinReport) {
    say!("{} simulated drives, {} buffers, {} rejected", r.runs, r.buffers, r.rejected);
    say!(
        "NEES over 6 at the end: median {:.2} (χ²: 0.89), mean {:.2}; inside the two-sided 95 % interval: {:.3} of the drives, above it {:.3}",
        r.nees_median_over_dof,
        r.nees_mean_over_dof,
        r.nees_inside_95,
        r.nees_above_95
    );
    say!("NIS over its degrees of freedom: mean {:.2}; inside: {:.3} of the buffers", r.nis_mean_over_dof, r.nis_inside_95);
    say!("90 % intervals that hold the truth: {:.3}; of the posterior as it goes out: {:.3}", r.coverage_90, r.coverage_90_posterior);
    say!("{:<28}{}", "", SOIL_NAMES.map(|n| format!("{n:>9}")).concat());
    for (title, row) in [("90 % intervals hold", &r.coverage_90_by_parameter), ("learned, share of drives", &r.learned)] {
        say!("{title:<28}{}", row.map(|v| format!("{v:>9.3}")).concat());
    }
    if let Some(ratio) = r.error_over_prior {
        say!("root mean square error of what was learned, over that of the prior: {ratio:.2}");
    }
}
