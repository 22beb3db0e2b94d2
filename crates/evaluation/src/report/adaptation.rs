//! The report of `nesam adapt`.

use nesam_physics::{SOIL_DIM, SOIL_LOGARITHMIC, SOIL_NAMES};

use crate::adapt_output::Adaptation;
use crate::dimension::{DIMENSION_KEYS, POSE_DIM};
use crate::evaluate::ModelScore;
use crate::report::table::Cell;
use crate::report::{LinePlot, Page, Series, Table};
use crate::score::{PerDimension, paired_difference};

const SOIL_UNITS: [&str; SOIL_DIM] = ["N/m^(n+2)", "N/m^(n+1)", "-", "Pa", "rad", "m"];
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
    page.plots(&[nis_plot(adaptation)], "NIS over degrees of freedom of every buffer; a consistent filter stays near 1.");
    page.section("Soil over time").plots(
        &soil_plots(adaptation),
        "Soil under the vehicle: the dashed line is the prior, the band one standard deviation of the posterior. Moduli, cohesion and shear modulus as \
         log10. A flat band as wide as at the start means: not learned.",
    );
    let p = adaptation.provenance;
    page.footer("command", &p.command)
        .footer("version", &format!("nesam {}", p.version))
        .footer("bundle", &format!("{} {}", p.bundle, p.bundle_hash))
        .footer("data", &p.data_hash)
        .footer("maps", &p.maps_hash)
        .footer("filter", &serde_json::to_string(&nesam_adaptation::FilterSettings::of(adaptation.filter)).unwrap_or_default())
        .footer("bootstrap", &format!("{} resamples by drive, seed {}", adaptation.resamples.count(), adaptation.seed));
    page.render()
}

fn error_table(a: &Adaptation<'_>, last: bool) -> Table {
    let which = if last { "step K" } else { "steps 1…K" };
    let head: Vec<&str> = std::iter::once("model").chain(DIMENSION_KEYS).chain(["position_m"]).collect();
    let mut table = Table::new(&format!("Mean absolute error, {which}; difference = adapted minus fixed on the same windows"), &head);
    let join = |six: [Option<f64>; POSE_DIM], position: Option<f64>| six.into_iter().chain([position]).collect::<Vec<_>>();
    let intervals =
        |six: &PerDimension<[f64; 2]>, position: Option<[f64; 2]>| six.to_array().into_iter().chain([position]).collect::<Vec<_>>();
    let mut add = |name: &str, values: Vec<Option<f64>>, ci95: Vec<Option<[f64; 2]>>| {
        let mut row = vec![Cell::from(name)];
        row.extend(values.into_iter().zip(ci95).map(|(value, interval)| Cell {
            text: value.map_or("–".into(), |v| format!("{v:.3}")),
            small: interval.map_or(String::new(), |[lo, hi]| format!("[{lo:.3}, {hi:.3}]")),
            best: false,
        }));
        table.row(row);
    };
    for (name, model) in [("fixed", a.fixed), ("adapted", a.adapted)] {
        let (t, c) = (&model.summary.tree, &model.summary.ci95);
        if last {
            add(name, join(t.mae_final.to_array(), t.position_m.final_), intervals(&c.mae_final, c.position_m.final_));
        } else {
            add(name, join(t.mae_mean.to_array(), t.position_m.mean), intervals(&c.mae_mean, c.position_m.mean));
        }
    }
    let (t, c) = paired_difference(&a.adapted.errors, &a.fixed.errors, a.resamples);
    let (r, rc) = (a.ratio(), a.ratio_ci95());
    if last {
        add("difference", join(t.mae_final.to_array(), t.position_m.final_), intervals(&c.mae_final, c.position_m.final_));
        add("ratio", join(r.mae_final.to_array(), r.position_m.final_), intervals(&rc.mae_final, rc.position_m.final_));
    } else {
        add("difference", join(t.mae_mean.to_array(), t.position_m.mean), intervals(&c.mae_mean, c.position_m.mean));
        add("ratio", join(r.mae_mean.to_array(), r.position_m.mean), intervals(&rc.mae_mean, rc.position_m.mean));
    }
    table
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
        plot.series = [line("fixed", 1, a.fixed, d), line("adapted", 2, a.adapted, d)].into_iter().flatten().collect();
        plot
    };
    panels.into_iter().filter(|(d, _, _)| a.fixed.curves[*d].is_some()).map(plot).collect()
}

fn nis_plot(a: &Adaptation<'_>) -> LinePlot {
    let mut plot = LinePlot::new("NIS over degrees of freedom", "time in the drive [s]", "NIS / dof [-]");
    plot.from_zero = true;
    for (drive, filtered) in a.filtered.iter().enumerate().take(DRIVES_PLOTTED) {
        let points = filtered.updates.iter().map(|u| (a.time_s(drive, u.sample), u.update.nis / u.update.dof as f64)).collect();
        plot.series.push(Series::line(&a.drives[drive].id, drive + 1, points));
    }
    plot
}

fn soil_plots(a: &Adaptation<'_>) -> Vec<LinePlot> {
    (0..SOIL_DIM)
        .map(|i| {
            let logarithmic = SOIL_LOGARITHMIC[i];
            let shown = |v: f64| if logarithmic { v.log10() } else { v };
            let unit = if logarithmic { format!("log10 of {}", SOIL_UNITS[i]) } else { SOIL_UNITS[i].into() };
            let mut plot = LinePlot::new(SOIL_NAMES[i], "time in the drive [s]", &format!("{} [{unit}]", SOIL_NAMES[i]));
            for (drive, filtered) in a.filtered.iter().enumerate().take(DRIVES_PLOTTED) {
                let at = |u: &crate::adapt::TimedUpdate| a.time_s(drive, u.sample);
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
                let prior = filtered.updates.iter().map(|u| (a.time_s(0, u.sample), shown(u.prior[i]))).collect();
                plot.series.push(Series::line(&format!("prior, {}", drive.id), 0, prior));
            }
            plot
        })
        .collect()
}
