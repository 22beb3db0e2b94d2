//! The report of `nesam evaluate`.

use crate::dimension::{DIMENSION_KEYS, POSE_DIM};
use crate::errors::PATH_FLOOR_M;
use crate::evaluate::{ModelPaths, ModelScore};
use crate::output::Evaluation;
use crate::report::table::Cell;
use crate::report::{LinePlot, Page, Series, Table};
use crate::score::{ErrorTree, paired_difference, values};
use crate::windows::Window;

const NAMES: [&str; POSE_DIM + 1] = ["x", "y", "z", "roll", "pitch", "yaw", "horizontal position"];
const UNITS: [&str; POSE_DIM + 1] = ["m", "m", "m", "deg", "deg", "deg", "m"];

/// The page: scores, errors over the horizon, paths, slices, comparisons, provenance.
pub fn evaluation_page(evaluation: &Evaluation<'_>, paths: &[ModelPaths], windows: &[Window<'_>]) -> String {
    let seconds = evaluation.horizon_steps as f64 * evaluation.dt_s;
    let lead = format!(
        "Predicted against measured motion on set {} ({} split): {} windows of {seconds:.1} s from {} drives, median path {:.1} m. \
         Errors are absolute, against the {} channels; brackets and bands are 95 % intervals from a bootstrap over drives.",
        evaluation.set,
        evaluation.split,
        evaluation.windows,
        evaluation.trajectories,
        evaluation.path_m_median,
        evaluation.truth.as_str(),
    );
    let mut page = Page::new(&format!("nesam evaluate: {}", evaluation.set), &lead);
    page.section("Mean absolute error over the horizon").table(&mae_table(evaluation, "steps 1…K", |t| t.mae_mean.to_array()));
    page.section("Mean absolute error at the last step").table(&mae_table(evaluation, "step K", |t| t.mae_final.to_array()));
    page.section("Horizontal position").table(&position_table(evaluation));
    if evaluation.models.len() > 1 {
        page.section("Paired differences").table(&difference_table(evaluation));
    }
    page.section("Error over the horizon")
        .plots(&horizon_plots(evaluation), "Mean absolute error after each step; bands are 95 % intervals.");
    page.section("Predicted and measured paths").plots(
        &path_plots(evaluation.models, paths, windows, evaluation),
        "Windows chosen by the rank of the first model's position error at the last step, from the smallest to the largest; a dot marks the start. x east, y north.",
    );
    if !evaluation.slices.is_empty() {
        page.section("Slices")
            .text("The same windows apart by world, class under the start, and terciles of this set by speed, turning, relief and slip.")
            .table(&slice_table(evaluation));
    }
    page.made_from(evaluation.provenance)
        .footer("bootstrap", &format!("{} resamples by drive, seed {}", evaluation.resamples.count(), evaluation.seed));
    page.render()
}

/// The tables of the page as Markdown, for documents: scores, position, differences, slices.
pub fn evaluation_markdown(evaluation: &Evaluation<'_>) -> String {
    let p = evaluation.provenance;
    let mut out = format!("`{}`, bundle {} {}\n\n", p.command, p.bundle, &p.bundle_hash[..p.bundle_hash.len().min(12)]);
    let mut tables = vec![
        mae_table(evaluation, "steps 1…K", |t| t.mae_mean.to_array()),
        mae_table(evaluation, "step K", |t| t.mae_final.to_array()),
        position_table(evaluation),
    ];
    if evaluation.models.len() > 1 {
        tables.push(difference_table(evaluation));
    }
    if !evaluation.slices.is_empty() {
        tables.push(slice_table(evaluation));
    }
    for table in tables {
        out += &table.to_markdown();
    }
    out
}

fn cell(value: Option<f64>, interval: Option<[f64; 2]>, best: Option<f64>) -> Cell {
    Cell { best: value.is_some() && value == best, ..Cell::with_interval(value, interval) }
}

fn smallest(values: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    values.flatten().min_by(f64::total_cmp)
}

fn mae_table(e: &Evaluation<'_>, which: &str, pick: fn(&ErrorTree<f64>) -> [Option<f64>; POSE_DIM]) -> Table {
    let head: Vec<&str> = std::iter::once("model").chain(DIMENSION_KEYS).chain(["parameters"]).collect();
    let mut table = Table::new(&format!("Mean absolute error, {which}; smallest in bold"), &head);
    let final_step = which == "step K";
    for model in e.models {
        let s = &model.summary;
        let value = pick(&s.tree);
        let interval = if final_step { s.ci95.mae_final.to_array() } else { s.ci95.mae_mean.to_array() };
        let mut row = vec![Cell::from(model.name.as_str())];
        row.extend((0..POSE_DIM).map(|d| {
            let best = smallest(e.models.iter().map(|m| pick(&m.summary.tree)[d]));
            cell(value[d], interval[d], best)
        }));
        row.push(model.parameters.to_string().into());
        table.row(row);
    }
    table
}

/// First model minus each other one on the same windows.
fn difference_table(e: &Evaluation<'_>) -> Table {
    let first = &e.models[0];
    let caption = format!("{} minus another model, same windows, steps 1…K; negative = {} is closer to the truth", first.name, first.name);
    let head: Vec<&str> = std::iter::once("against").chain(DIMENSION_KEYS).chain(["position_m"]).collect();
    let mut table = Table::new(&caption, &head);
    for other in &e.models[1..] {
        let (difference, interval) = paired_difference(&first.errors, &other.errors, e.resamples);
        let mut row = vec![Cell::from(other.name.as_str())];
        row.extend(difference.row(false).into_iter().zip(interval.row(false)).map(|(v, i)| Cell::with_interval(v, i)));
        table.row(row);
    }
    table
}

fn position_table(e: &Evaluation<'_>) -> Table {
    let head = ["model", "mean [m]", "at step K [m]", "median of error over path [-]"];
    let short = e.windows_below_path_floor();
    let caption =
        format!("Horizontal position error; smallest in bold; error over path without {short} windows of at most {PATH_FLOOR_M} m of path");
    let mut table = Table::new(&caption, &head);
    let pick = |m: &ModelScore| {
        let p = m.summary.tree.position_m;
        [p.mean, p.final_, p.final_over_path_median]
    };
    for model in e.models {
        let c = model.summary.ci95.position_m;
        let intervals = [c.mean, c.final_, c.final_over_path_median];
        let mut row = vec![Cell::from(model.name.as_str())];
        row.extend((0..3).map(|i| cell(pick(model)[i], intervals[i], smallest(e.models.iter().map(|m| pick(m)[i])))));
        table.row(row);
    }
    table
}

fn horizon_plots(e: &Evaluation<'_>) -> Vec<LinePlot> {
    let order = [POSE_DIM, 0, 1, 2, 3, 4, 5];
    order
        .into_iter()
        .filter(|&d| e.models.iter().any(|m| m.curves[d].is_some()))
        .map(|d| {
            let mut plot = LinePlot::new(NAMES[d], "time ahead [s]", &format!("mean absolute error [{}]", UNITS[d]));
            plot.from_zero = true;
            let time = |k: usize| (k + 1) as f64 * e.dt_s;
            for (i, model) in e.models.iter().enumerate() {
                let Some(curve) = &model.curves[d] else { continue };
                let points = curve.mean.iter().enumerate().map(|(k, v)| (time(k), *v)).collect();
                let mut series = Series::line(model.name.as_str(), i + 1, points);
                series.band = curve.ci95.iter().enumerate().map(|(k, [lo, hi])| (time(k), *lo, *hi)).collect();
                plot.series.push(series);
            }
            plot
        })
        .collect()
}

fn path_plots(models: &[ModelScore], paths: &[ModelPaths], windows: &[Window<'_>], e: &Evaluation<'_>) -> Vec<LinePlot> {
    let Some(first) = models.first() else { return Vec::new() };
    let last = first.errors.column(first.errors.horizon - 1, POSE_DIM);
    let mut rank: Vec<usize> = (0..windows.len()).collect();
    rank.sort_by(|a, b| last[*a].total_cmp(&last[*b]));
    let mut chosen: Vec<usize> =
        [0.0, 0.2, 0.4, 0.5, 0.6, 0.75, 0.9, 0.97, 1.0].iter().map(|q| rank[(q * (rank.len() - 1) as f64) as usize]).collect();
    chosen.dedup();
    chosen
        .into_iter()
        .map(|w| {
            let window = &windows[w];
            let title = format!("{} from {:.1} s (error {:.2} m)", window.trajectory.id, window.start_time_s(), last[w]);
            let mut plot = LinePlot::new(&title, "x [m]", "y [m]");
            plot.equal_aspect = true;
            let from = |start: crate::Pose, poses: &[crate::Pose]| -> Vec<(f64, f64)> {
                std::iter::once((start[0], start[1])).chain(poses.iter().map(|p| (p[0], p[1]))).collect()
            };
            let mut measured = Series::line("measured", 0, from(window.true_start(e.truth), &window.truth(e.truth)));
            measured.mark_start = true;
            plot.series.push(measured);
            for (i, model) in paths.iter().enumerate() {
                plot.series.push(Series::line(model.name.as_str(), i + 1, from(window.start_pose(), &model.paths[w].poses)));
            }
            plot
        })
        .collect()
}

fn slice_table(e: &Evaluation<'_>) -> Table {
    let head = ["slice", "windows", "model", "position at K [m]", "position mean [m]", "z [m]", "roll [deg]", "pitch [deg]", "yaw [deg]"];
    let mut table = Table::new("Errors by slice; angles and z are means over steps 1…K", &head);
    for slice in e.slices {
        for model in e.models {
            let t = values(&model.errors.filter(|w| slice.member[w]));
            let numbers =
                [t.position_m.final_, t.position_m.mean, t.mae_mean.z_m, t.mae_mean.roll_deg, t.mae_mean.pitch_deg, t.mae_mean.yaw_deg];
            let mut row: Vec<Cell> = vec![slice.name.as_str().into(), slice.windows().to_string().into(), model.name.as_str().into()];
            row.extend(numbers.map(|v| Cell::with_interval(v, None)));
            table.row(row);
        }
    }
    table
}
