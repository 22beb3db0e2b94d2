//! The report of `nesam adapt`.

use std::collections::BTreeMap;

use nesam_adaptation::{SoilUpdate, chi_square_tail};
use nesam_physics::{SOIL_DIM, SOIL_LOGARITHMIC, SOIL_NAMES, SOIL_UNITS};

use crate::adapt_output::Adaptation;
use crate::dimension::{DIMENSION_KEYS, POSE_DIM};
use crate::evaluate::ModelScore;
use crate::known_soil::KnownSoil;
use crate::report::table::Cell;
use crate::report::{LinePlot, Page, Series, Table};
use crate::score::{ErrorTree, paired_difference};

/// Drives whose soil is plotted; more would not fit the eye.
const DRIVES_PLOTTED: usize = 6;

/// The page: fixed against adapted, soil over time, consistency, provenance.
pub fn adaptation_page(adaptation: &Adaptation<'_>) -> String {
    let c = adaptation.consistency();
    let share = |v: Option<f64>| v.map_or("–".into(), |v| format!("{v:.2}"));
    let lead = format!(
        "Soil learned while driving on set {} ({} split): {} windows of {:.1} s from {} drives, errors against the {} channels. Fixed predicts with the \
         soil prior; adapted with the posterior of the measurements up to the start of each window, from the prior at the start of each drive.",
        adaptation.set,
        adaptation.split,
        adaptation.fixed.summary.windows,
        adaptation.horizon_steps as f64 * adaptation.dt_s,
        adaptation.drives.len(),
        adaptation.truth.as_str(),
    );
    let mut page = Page::new(&format!("nesam adapt: {}", adaptation.set), &lead);
    page.section("Mean absolute error over the horizon").table(&error_table(adaptation, false));
    page.section("Mean absolute error at the last step").table(&error_table(adaptation, true));
    page.section("Error over the horizon")
        .plots(&horizon_plots(adaptation), "Mean absolute error after each step; bands are 95 % intervals from a bootstrap over drives.");
    page.section("Consistency").text(&format!(
        "{} updates, {} buffers rejected by the gate, {} given up. NIS over its degrees of freedom: mean {}, median {} (1 for a consistent filter); \
         share of buffers inside the two-sided 95 % interval: {}.",
        c.updates,
        c.rejected,
        c.failed,
        share(c.nis_mean_over_dof),
        share(c.nis_median_over_dof),
        share(c.inside_95),
    ));
    if let Some(known) = adaptation.known_soil {
        add_known_soil(&mut page, known);
    }
    page.plots(
        &[nis_plot(adaptation), trust_plot(adaptation), scale_plot(adaptation)],
        "NIS over degrees of freedom of every buffer: a consistent filter stays near 1, and a buffer above the gate is rejected. Trust is the weight of the correction \
         against the prior alone, noise the factor on R_B in force.",
    );
    page.section("Error over the drive").plots(
        &over_time_plots(adaptation),
        "Mean absolute error of the windows that start at a time, over all drives: what learning gains as it goes on.",
    );
    page.section("Soil over time").plots(
        &soil_plots(adaptation),
        "Soil under the vehicle: the prior is that of the first drive, the band one standard deviation of the posterior. Moduli, cohesion and shear modulus as \
         log10. A flat band as wide as at the start means: not learned.",
    );
    page.made_from(adaptation.provenance)
        .footer("filter", &serde_json::to_string(&nesam_adaptation::FilterSettings::of(adaptation.filter)).unwrap_or_default())
        .footer("bootstrap", &format!("{} resamples by drive, seed {}", adaptation.resamples.count(), adaptation.seed));
    page.render()
}

fn error_table(a: &Adaptation<'_>, last: bool) -> Table {
    let which = if last { "step K" } else { "steps 1…K" };
    let head: Vec<&str> = std::iter::once("model").chain(DIMENSION_KEYS).chain(["position_m"]).collect();
    let mut table = Table::new(&format!("Mean absolute error, {which}; difference = adapted minus fixed on the same windows"), &head);
    let mut add = |name: &str, values: &ErrorTree<f64>, intervals: &ErrorTree<[f64; 2]>| {
        let cells = values.row(last).into_iter().zip(intervals.row(last)).map(|(value, interval)| Cell::with_interval(value, interval));
        table.row(std::iter::once(Cell::from(name)).chain(cells).collect());
    };
    for (name, model) in a.models() {
        add(name, &model.summary.tree, &model.summary.ci95);
    }
    let (difference, interval) = paired_difference(&a.adapted.errors, &a.fixed.errors, a.resamples);
    add("difference", &difference, &interval);
    add("ratio", &a.ratio(), &a.ratio_ci95());
    table
}

/// Adds what was learned, held against the simulator's own soil.
fn add_known_soil(page: &mut Page, known: &KnownSoil) {
    page.text(&known.sentence());
    let head: Vec<&str> = std::iter::once("what was learned").chain(SOIL_NAMES).collect();
    let mut table = Table::new("By parameter; an error below 1 is nearer to the simulator's soil than the prior", &head);
    for (name, values) in known.by_parameter() {
        table.row(std::iter::once(name.into()).chain(values.iter().map(|v| format!("{v:.2}").into())).collect());
    }
    page.table(&table);
}

fn horizon_plots(a: &Adaptation<'_>) -> Vec<LinePlot> {
    let panels = [(POSE_DIM, "horizontal position", "m"), (2, "z", "m"), (3, "roll", "deg"), (4, "pitch", "deg"), (5, "yaw", "deg")];
    let time = |k: usize| (k + 1) as f64 * a.dt_s;
    let line = |name: &str, colour: usize, model: &ModelScore, d: usize| {
        model.curves[d].as_ref().map(|curve| {
            let mut series = Series::line(name, colour, curve.mean.iter().enumerate().map(|(k, v)| (time(k), *v)).collect());
            series.band = curve.ci95.iter().enumerate().map(|(k, [lo, hi])| (time(k), *lo, *hi)).collect();
            series
        })
    };
    let plot = |(d, name, unit): (usize, &str, &str)| {
        let mut plot = LinePlot::new(name, "time ahead [s]", &format!("mean absolute error [{unit}]"));
        plot.from_zero = true;
        plot.series = a.models().enumerate().filter_map(|(i, (name, model))| line(name, i + 1, model, d)).collect();
        plot
    };
    panels.into_iter().filter(|(d, _, _)| a.fixed.curves[*d].is_some()).map(plot).collect()
}

fn nis_plot(a: &Adaptation<'_>) -> LinePlot {
    let mut plot = by_buffer(a, "NIS over degrees of freedom", "NIS / dof [-]", |u| u.nis / u.dof as f64);
    if let Some(gate) = gate_over_dof(a) {
        let end_s = plot.series.iter().flat_map(|s| &s.points).map(|p| p.0).fold(0.0, f64::max);
        plot.series.push(Series::line("gate", 0, vec![(0.0, gate), (end_s, gate)]));
    }
    plot
}

/// Smallest NIS over degrees of freedom that the gate refuses; `None` without a gate.
fn gate_over_dof(a: &Adaptation<'_>) -> Option<f64> {
    let dof = a.filter.rows();
    let share = Some(a.filter.gate_tail_probability).filter(|p| *p > 0.0)?;
    let (mut low, mut high) = (0.0, 1000.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if chi_square_tail(dof, middle * dof as f64) < share { high = middle } else { low = middle }
    }
    Some(high)
}

fn trust_plot(a: &Adaptation<'_>) -> LinePlot {
    by_buffer(a, "trust in the correction", "weight [-]", |u| u.trust)
}

fn scale_plot(a: &Adaptation<'_>) -> LinePlot {
    by_buffer(a, "noise", "factor on R_B [-]", |u| u.noise_scale)
}

fn by_buffer(a: &Adaptation<'_>, title: &str, label: &str, value: impl Fn(&SoilUpdate) -> f64) -> LinePlot {
    let mut plot = LinePlot::new(title, "time in the drive [s]", label);
    plot.from_zero = true;
    for (drive, filtered) in a.filtered.iter().enumerate().take(DRIVES_PLOTTED) {
        let points = filtered.updates.iter().map(|u| (a.since_log_start_s(drive, u.sample), value(&u.update))).collect();
        plot.series.push(Series::line(&a.drives[drive].id, drive + 1, points));
    }
    plot
}

/// Error against the time at which the windows start, by step of five seconds.
fn over_time_plots(a: &Adaptation<'_>) -> Vec<LinePlot> {
    const EVERY_S: f64 = 5.0;
    let panels = [(POSE_DIM, "horizontal position", "m"), (5, "yaw", "deg"), (2, "z", "m")];
    let line = |name: &str, colour: usize, model: &ModelScore, d: usize| {
        let mut bins: BTreeMap<usize, [f64; 2]> = BTreeMap::new();
        for (w, start_s) in a.starts_s.iter().enumerate().take(model.errors.windows()) {
            let steps = model.errors.window(w);
            let error = steps.iter().map(|s| if d < POSE_DIM { s.absolute[d] } else { s.position_m }).sum::<f64>() / steps.len() as f64;
            if error.is_nan() {
                continue; // Not measured.
            }
            let bin = bins.entry((start_s / EVERY_S) as usize).or_default();
            bin[0] += error;
            bin[1] += 1.0;
        }
        let point = |(bin, [sum, count]): (&usize, &[f64; 2])| ((*bin as f64 + 0.5) * EVERY_S, sum / count);
        Series::line(name, colour, bins.iter().map(point).collect())
    };
    let plot = |(d, name, unit): (usize, &str, &str)| {
        let mut plot = LinePlot::new(name, "start of the window in the drive [s]", &format!("mean absolute error [{unit}]"));
        plot.from_zero = true;
        plot.series = a.models().enumerate().map(|(i, (name, model))| line(name, i + 1, model, d)).collect();
        plot
    };
    panels.into_iter().filter(|(d, _, _)| a.fixed.curves[*d].is_some()).map(plot).collect()
}

fn soil_plots(a: &Adaptation<'_>) -> Vec<LinePlot> {
    (0..SOIL_DIM)
        .map(|i| {
            let logarithmic = SOIL_LOGARITHMIC[i];
            let shown = |v: f64| if logarithmic { v.log10() } else { v };
            let unit = if logarithmic { format!("log10 of {}", SOIL_UNITS[i]) } else { SOIL_UNITS[i].into() };
            let mut plot = LinePlot::new(SOIL_NAMES[i], "time in the drive [s]", &format!("{} [{unit}]", SOIL_NAMES[i]));
            for (drive, filtered) in a.filtered.iter().enumerate().take(DRIVES_PLOTTED) {
                let at = |u: &crate::adapt::TimedUpdate| a.since_log_start_s(drive, u.sample);
                let soil: Vec<(f64, f64)> = filtered.updates.iter().map(|u| (at(u), shown(u.soil()[i]))).collect();
                let mut series = Series::line(&a.drives[drive].id, drive + 1, soil);
                series.band = filtered
                    .updates
                    .iter()
                    .map(|u| (at(u), u, u.update.posterior.sd(&u.prior)[i]))
                    .map(|(t, u, sd)| {
                        let theta = u.soil()[i];
                        let half = if logarithmic { sd / theta / std::f64::consts::LN_10 } else { sd };
                        (t, shown(theta) - half, shown(theta) + half)
                    })
                    .collect();
                plot.series.push(series);
            }
            if let (Some(filtered), Some(drive)) = (a.filtered.first(), a.drives.first()) {
                let prior = filtered.updates.iter().map(|u| (a.since_log_start_s(0, u.sample), shown(u.prior[i]))).collect();
                plot.series.push(Series::line(&format!("prior, {}", drive.id), 0, prior));
            }
            plot
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use nesam_adaptation::{Agreement, ClassBelief, FilterConfig, SoilPosterior, VELOCITY_DIM};
    use nesam_physics::{Control, SoilCorrection, VehicleState};
    use nesam_trajectories::{MeasuredChannels, Trajectory};

    use super::*;
    use crate::{
        DriveAdaptation, ModelName, Provenance, Resamples, TimedUpdate, Truth, Window, WindowPredictor, all_windows, predict_all, score,
    };

    /// Steps of an eighth of a second from `start_s` on, which numbers of any clock hold exactly.
    fn drive(start_s: f64) -> Trajectory {
        const SAMPLES: usize = 70;
        let state = |i: usize| VehicleState { position_m: [0.01 * (i * i) as f64, 0.0, 0.0], ..VehicleState::zero() };
        Trajectory {
            id: "a".into(),
            set: "synthetic".into(),
            world: None,
            split: None,
            dt_s: 0.125,
            time_s: (0..SAMPLES).map(|i| start_s + 0.125 * i as f64).collect(),
            states: (0..SAMPLES).map(state).collect(),
            controls: vec![Control { speed_m_s: 2.0, second: 0.0 }; SAMPLES],
            wheel_speed_rad_s: None,
            road_wheel_angle_rad: None,
            measured: MeasuredChannels::POSE_AND_TWIST,
            truth: None,
        }
    }

    fn update(sample: usize) -> TimedUpdate {
        let covariance = [[0.01; SOIL_DIM]; SOIL_DIM];
        let agreement =
            Agreement { nis: 6.0, dof: 6, mean: [0.0; VELOCITY_DIM], normalised: [0.0; VELOCITY_DIM], weighed: 6.0, beyond_soil: 6.0 };
        let update = SoilUpdate {
            posterior: SoilPosterior { correction: SoilCorrection::NONE, covariance, learned: [true; SOIL_DIM] },
            before: ClassBelief { delta: [0.0; SOIL_DIM], covariance },
            innovation: Vec::new(),
            nis: 6.0,
            dof: 6,
            agreement,
            rejected: false,
            excited: true,
            excitation: 1.0,
            log_likelihood: 0.0,
            trust: 0.5,
            noise_scale: 1.0,
        };
        TimedUpdate { sample, prior: [1.3e6, 8.0e3, 0.8, 3.0e3, 0.42, 0.015], update, class: 0, corrections: Vec::new() }
    }

    /// The page of a drive whose clock begins at `start_s`.
    fn page(start_s: f64, known_soil: Option<&KnownSoil>) -> String {
        let drives = [drive(start_s)];
        let windows = all_windows(&drives, 8, 8, Truth::Measured).unwrap();
        let models = [(ModelName::ConstantVelocity, WindowPredictor::ConstantVelocity)];
        let paths = predict_all(&models, &windows, &[None], &|_| {}).unwrap();
        let resamples = Resamples::draw(1, 100, 1);
        let scored = score(&paths[0], &windows, Truth::Measured, &resamples);
        adaptation_page(&Adaptation {
            set: "synthetic",
            split: "all",
            horizon_steps: 8,
            dt_s: 0.125,
            path_m_median: 1.0,
            truth: Truth::Measured,
            starts_s: &windows.iter().map(Window::since_log_start_s).collect::<Vec<_>>(),
            maps: &[None],
            drives: &drives,
            fixed: &scored,
            adapted: &scored,
            others: &[],
            apart: &[],
            reference: None,
            filtered: &[DriveAdaptation { updates: vec![update(16), update(56)], ..DriveAdaptation::default() }],
            known_soil,
            filter: &FilterConfig::default(),
            seed: 1,
            resamples: &resamples,
            provenance: &Provenance::default(),
        })
    }

    #[test]
    fn property_plots_over_time_do_not_depend_on_the_clock_of_the_vehicle() {
        assert!(page(0.0, None) == page(1.75e9, None), "a clock that counts from 1970 changes the page");
    }

    #[test]
    fn property_known_soil_is_on_the_page_where_it_was_read() {
        let known = KnownSoil {
            updates: 17,
            nees_median_over_dof: 1.25,
            nees_inside_95: 0.75,
            nees_inside_95_ci95: None,
            coverage_90: 0.91,
            coverage_90_ci95: Some([0.5, 1.0]),
            coverage_90_by_parameter: [0.87; SOIL_DIM],
            error_over_prior: [0.63; SOIL_DIM],
        };
        let with = page(0.0, Some(&known));
        for told in ["after 17 updates", "over 6 1.25", "0.91 [0.50, 1.00]", "<td>0.87</td>", "<td>0.63</td>"] {
            assert!(with.contains(told), "{told} is not on the page");
        }
        assert!(!page(0.0, None).contains("simulator"));
    }
}
