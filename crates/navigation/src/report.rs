//! JSON (`nesam.navigate/1`) and HTML of closed-loop runs.

use std::collections::BTreeMap;
use std::path::PathBuf;

use nesam_evaluation::report::{LinePlot, Page, Series, Table};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::lap::Lap;
use crate::reference_path::ReferencePath;
use crate::score::{Figures, Ratio, Run, Summary, configuration_names, ratio, summarise};

/// How the true soil of a world differs from what its classes promise.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SoilKind {
    /// Softer everywhere.
    Soft,
    /// Firmer everywhere.
    Firm,
    /// Some softer, some firmer.
    Mixed,
    /// As promised.
    Nominal,
    /// Not known: the data root does not tell the true soil.
    Unknown,
}

impl SoilKind {
    /// All, in the order of reports.
    pub const ALL: [Self; 5] = [Self::Soft, Self::Firm, Self::Mixed, Self::Nominal, Self::Unknown];

    /// As in JSON.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Soft => "soft",
            Self::Firm => "firm",
            Self::Mixed => "mixed",
            Self::Nominal => "nominal",
            Self::Unknown => "unknown",
        }
    }
}

/// The configuration that others are compared with.
const BASE: &str = "fixed";
/// Ends of laps that are told of a configuration.
const ENDS_MAX: usize = 5;
/// Quantities that are compared: distances over the part that each drove, of laps that were driven out, angles over the part that both drove.
const COMPARED: [(&str, fn(&Lap, f64) -> Option<f64>); 4] = [
    ("hausdorff_m", driven_out_hausdorff_m),
    ("off_path_m", |lap, _| lap.off_path_mean_m.filter(|_| lap.is_driven_out())),
    ("roll_deg", roll_deg),
    ("pitch_deg", pitch_deg),
];

fn driven_out_hausdorff_m(lap: &Lap, _: f64) -> Option<f64> {
    lap.hausdorff_m.filter(|_| lap.is_driven_out())
}

fn roll_deg(lap: &Lap, progress: f64) -> Option<f64> {
    lap.mean_lean_until(progress, |lean| lean.roll_deg)
}

fn pitch_deg(lap: &Lap, progress: f64) -> Option<f64> {
    lap.mean_lean_until(progress, |lean| lean.pitch_deg)
}

/// All runs of a command.
#[derive(Clone, Debug)]
pub struct NavigationReport {
    /// Runs.
    pub runs: Vec<Run>,
    /// Settings of planner and scenario, for the JSON.
    pub settings: Value,
    /// Folder with a file for each lap: its path, and how the vehicle leant on it.
    pub folder: PathBuf,
    /// What is doubtful about them, a sentence each.
    pub warnings: Vec<String>,
    /// What the numbers were made from: name and value, for JSON and footer.
    pub provenance: Vec<(String, String)>,
}

impl NavigationReport {
    /// The JSON of the contract, extended by intervals, kinds of soil and comparisons with `fixed`. `runs` are the laps of each configuration (the most that one
    /// has, where the command ended early), `laps` all of them. `hausdorff_m` is over the part of the path that a lap drove, `hausdorff_whole_path_m` over all of it.
    pub fn to_json(&self) -> Value {
        let configurations: Map<String, Value> = configuration_names(&self.runs)
            .iter()
            .filter_map(|name| {
                let mut value = summarise(&self.runs, name, None).map(|s| of_summary(&s))?;
                let kinds: Map<String, Value> = SoilKind::ALL
                    .iter()
                    .filter_map(|kind| Some((kind.as_str().to_string(), of_summary(&summarise(&self.runs, name, Some(*kind))?))))
                    .collect();
                value["by_soil"] = Value::Object(kinds);
                value["over_fixed"] = self.comparisons(name);
                Some((name.clone(), value))
            })
            .collect();
        let provenance: Map<String, Value> = self.provenance.iter().map(|(name, value)| (name.clone(), json!(value))).collect();
        let each = self.runs.iter().map(|run| {
            let mut value = json!(run);
            // Step by step they are in the file of the lap; the HTML draws the paths.
            if let Some(lap) = value["lap"].as_object_mut() {
                lap.retain(|key, _| key != "path" && key != "lean");
            }
            value["file"] = json!(self.folder.join(run.file_name()));
            value
        });
        let of = |name: &String| self.runs.iter().filter(|run| run.configuration == *name).count();
        json!({
            "schema": "nesam.navigate/1",
            "runs": configuration_names(&self.runs).iter().map(of).max().unwrap_or(0),
            "laps": self.runs.len(),
            "configurations": configurations,
            "warnings": self.warnings,
            "settings": self.settings,
            "provenance": provenance,
            "each": each.collect::<Vec<_>>(),
        })
    }

    /// Ratios of a configuration over `fixed` on all soils and on each kind.
    fn comparisons(&self, name: &str) -> Value {
        let kinds = std::iter::once(None).chain(SoilKind::ALL.map(Some));
        let of_kind = |kind: Option<SoilKind>| {
            let quantities: Map<String, Value> = COMPARED
                .iter()
                .filter_map(|(key, of)| Some(((*key).to_string(), json!(ratio(&self.runs, name, BASE, kind, *of)?))))
                .collect();
            (kind.map_or("all", SoilKind::as_str).to_string(), Value::Object(quantities))
        };
        let object: Map<String, Value> = kinds.map(of_kind).filter(|(_, v)| v.as_object().is_some_and(|o| !o.is_empty())).collect();
        Value::Object(object)
    }

    /// The table as rows of texts: soil, configuration, runs, completion, time, Hausdorff, mean distance, roll, pitch, and the last but the second over those of
    /// `fixed`.
    pub fn rows(&self) -> Vec<[String; 12]> {
        let kinds: Vec<Option<SoilKind>> = std::iter::once(None).chain(SoilKind::ALL.map(Some)).collect();
        let mut rows = Vec::new();
        for kind in kinds {
            for name in configuration_names(&self.runs) {
                let Some(s) = summarise(&self.runs, &name, kind) else { continue };
                let over_fixed =
                    |of| ratio(&self.runs, &name, BASE, kind, of).filter(|_| name != BASE).map_or("–".into(), |r| ratio_text(&r));
                rows.push([
                    kind.map_or("all", SoilKind::as_str).to_string(),
                    name.clone(),
                    s.runs.to_string(),
                    format!("{:.0} % [{:.0}, {:.0}]", 100.0 * s.completion, 100.0 * s.completion_ci95[0], 100.0 * s.completion_ci95[1]),
                    mean_sd(&s.time_s, 1),
                    with_interval(&s.hausdorff_m, 2),
                    mean_sd(&s.off_path_m, 2),
                    mean_sd(&s.roll_deg, 2),
                    mean_sd(&s.pitch_deg, 2),
                    over_fixed(driven_out_hausdorff_m),
                    over_fixed(roll_deg),
                    over_fixed(pitch_deg),
                ]);
            }
        }
        rows
    }

    /// Why laps were not completed: a line for each configuration with such laps.
    pub fn ends(&self) -> Vec<String> {
        let of = |name: &String| {
            let incomplete: Vec<&Lap> =
                self.runs.iter().filter(|run| run.configuration == *name && !run.lap.completed).map(|run| &run.lap).collect();
            (!incomplete.is_empty()).then(|| format!("{name}: {}", ends_text(&incomplete)))
        };
        configuration_names(&self.runs).iter().filter_map(of).collect()
    }

    /// Heads of the columns of [`NavigationReport::rows`].
    pub const HEAD: [&'static str; 12] = [
        "soil",
        "model",
        "runs",
        "completed",
        "time s",
        "Hausdorff m",
        "off path m",
        "|roll| °",
        "|pitch| °",
        "Hausdorff / fixed",
        "|roll| / fixed",
        "|pitch| / fixed",
    ];

    /// The HTML page.
    pub fn page(&self) -> Page {
        let names = configuration_names(&self.runs);
        let lead = format!(
            "{} laps of a closed path on deformable soil, driven by one sampling planner whose predictions come from {}. Mean ± standard deviation; intervals \
             95 %, bootstrap over world and start.",
            self.runs.len(),
            names.join(", ")
        );
        let mut page = Page::new("Closed-loop driving", &lead);
        let mut table = Table::new(
            "Completed = the whole lap in time, never more than 5 m off. Time over completed laps only; |roll| and |pitch| over fixed on the part that both laps of a pair drove, distances of laps \
             that no plant ended.",
            &Self::HEAD,
        );
        for row in self.rows() {
            table.row(row.into_iter().map(Into::into).collect());
        }
        page.section("What came of it").table(&table);
        for ends in self.ends() {
            page.text(&format!("Not completed by {ends}."));
        }
        if !self.warnings.is_empty() {
            page.section("What is doubtful");
            for warning in &self.warnings {
                page.text(warning);
            }
        }
        let path = ReferencePath::of_ood_soil();
        let reference: Vec<(f64, f64)> = path.points_between(0.0, std::f64::consts::TAU, 0.5).iter().map(|[x, y]| (*x, *y)).collect();
        let mut worlds: Vec<(&str, SoilKind)> = self.runs.iter().map(|r| (r.world.as_str(), r.soil)).collect();
        worlds.sort_unstable();
        worlds.dedup();
        page.section("Paths driven");
        for name in &names {
            let plots: Vec<LinePlot> = worlds.iter().map(|(world, soil)| self.plot(name, world, *soil, &reference)).collect();
            page.plots(&plots, &format!("{name}: the path to follow (ink) and every lap (colour), x east and y north in m."));
        }
        for (name, value) in &self.provenance {
            page.footer(name, value);
        }
        page.footer("settings", &self.settings.to_string());
        page
    }

    fn plot(&self, name: &str, world: &str, soil: SoilKind, reference: &[(f64, f64)]) -> LinePlot {
        let mut plot = LinePlot::new(&format!("{world} ({}), {name}", soil.as_str()), "x m", "y m");
        plot.equal_aspect = true;
        plot.series.push(Series::line("path to follow", 0, reference.to_vec()));
        for run in self.runs.iter().filter(|r| r.configuration == name && r.world == world) {
            // Every second position is enough to see, and the last.
            let path = &run.lap.path;
            let last = path.last().filter(|_| path.len().is_multiple_of(2));
            let points = path.iter().step_by(2).chain(last).map(|[x, y]| (*x, *y)).collect();
            let label = format!("start {}, seed {}: {}", run.start, run.seed, run.lap.end);
            plot.series.push(Series::line(&label, 1 + (run.seed as usize + 3 * run.start) % 6, points));
        }
        plot
    }
}

/// Configurations of which every lap is lost: that is no way to drive, but a simulation that diverges or readings that are none.
pub fn lost(runs: &[Run]) -> Vec<String> {
    let all_lost = |name: &String| runs.iter().filter(|run| run.configuration == *name).all(|run| run.lap.end == "plant_lost");
    configuration_names(runs).into_iter().filter(all_lost).collect()
}

fn of_summary(s: &Summary) -> Value {
    let figures = |f: &Figures| json!({ "mean": finite(f.mean), "sd": finite(f.sd), "ci95": f.ci95 });
    json!({
        "runs": s.runs,
        "never_began": s.never_began,
        "places": s.places,
        "completion": s.completion,
        "completion_ci95": s.completion_ci95,
        "time_s": figures(&s.time_s),
        "hausdorff_m": figures(&s.hausdorff_m),
        "hausdorff_whole_path_m": figures(&s.hausdorff_whole_path_m),
        "off_path_m": figures(&s.off_path_m),
        "roll_deg": figures(&s.roll_deg),
        "pitch_deg": figures(&s.pitch_deg),
    })
}

/// Null where no run counts.
fn finite(value: f64) -> Option<f64> {
    Some(value).filter(|v| v.is_finite())
}

/// The deviation of one lap is none.
fn mean_sd(f: &Figures, digits: usize) -> String {
    match [f.mean, f.sd].map(finite) {
        [None, _] => "–".into(),
        [Some(mean), None] => format!("{mean:.digits$} ± –"),
        [Some(mean), Some(sd)] => format!("{mean:.digits$} ± {sd:.digits$}"),
    }
}

/// How laps ended, the most frequent first, with their times since the beginning of the lap.
fn ends_text(laps: &[&Lap]) -> String {
    let mut ends: BTreeMap<&str, Vec<&Lap>> = BTreeMap::new();
    laps.iter().for_each(|lap| ends.entry(&lap.end).or_default().push(lap));
    let mut ends: Vec<_> = ends.into_iter().collect();
    ends.sort_by_key(|(_, laps)| std::cmp::Reverse(laps.len()));
    let others: usize = ends.iter().skip(ENDS_MAX).map(|(_, laps)| laps.len()).sum();
    let told = ends.iter().take(ENDS_MAX).map(|(end, laps)| format!("{end} {} ({})", laps.len(), when(laps)));
    told.chain((others > 0).then(|| format!("other ends {others}"))).collect::<Vec<_>>().join(", ")
}

fn when(laps: &[&Lap]) -> String {
    if laps.iter().any(|lap| !lap.is_begun()) {
        let begun = laps.iter().filter(|lap| lap.is_begun()).count();
        return if begun == 0 { "before the lap began".into() } else { format!("{} before the lap began", laps.len() - begun) };
    }
    let times_s = laps.iter().map(|lap| lap.time_s);
    let [first, last] = [times_s.clone().fold(f64::INFINITY, f64::min), times_s.fold(0.0, f64::max)].map(|s| format!("{s:.1}"));
    if first == last { format!("at {first} s") } else { format!("at {first} to {last} s") }
}

fn with_interval(f: &Figures, digits: usize) -> String {
    let interval = f.ci95.map_or(String::new(), |[low, high]| format!(" [{low:.digits$}, {high:.digits$}]"));
    mean_sd(f, digits) + &interval
}

fn ratio_text(r: &Ratio) -> String {
    let interval = r.ci95.map_or(String::new(), |[low, high]| format!(" [{low:.2}, {high:.2}]"));
    format!("{:.2}{interval}", r.ratio)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::score::tests::{never_begun, run};

    fn report(runs: Vec<Run>) -> NavigationReport {
        NavigationReport { runs, settings: json!({}), folder: "laps".into(), warnings: Vec::new(), provenance: Vec::new() }
    }

    /// Goal: who reads the table learns why laps were not completed. Method: laps that end in several ways, and none that is complete but one.
    #[test]
    fn regress_why_laps_were_not_completed_is_told() {
        let ended = |configuration: &str, seed: u64, end: &str, time_s: f64| {
            let mut run = run(configuration, "a", 0, seed, 1.0, end == "complete");
            (run.lap.end, run.lap.time_s) = (end.into(), time_s);
            run
        };
        let mut runs = vec![ended("kinematic", 1, "complete", 50.0), never_begun(run("fixed", "a", 0, 1, 1.0, false))];
        runs.extend([3.4, 3.42].map(|time_s| ended("fixed", 2, "off_path", time_s)));
        runs.extend([("plant_lost", 2.0), ("plant_lost", 12.04)].map(|(end, time_s)| ended("adapted", 3, end, time_s)));
        let told = report(runs.clone());
        assert_eq!(
            told.ends(),
            ["fixed: off_path 2 (at 3.4 s), spawn blocked 1 (before the lap began)", "adapted: plant_lost 2 (at 2.0 to 12.0 s)"]
        );
        assert_eq!(lost(&told.runs), ["adapted"]);
        runs.extend((0..6).map(|i| ended("oracle", i, &format!("ditch {i}"), 1.0)));
        let told = report(runs).ends();
        assert!(told[2].starts_with("oracle: ditch 0 1 (at 1.0 s), ") && told[2].ends_with(", other ends 1"), "{told:?}");
    }

    /// Goal: what was never driven is null in the JSON, a dash in the table and an empty line in the page. Method: one lap alone, which was blocked; then one that
    /// was driven, which has no deviation.
    #[test]
    fn regress_figures_without_laps_are_none() {
        let blocked = report(vec![never_begun(run("fixed", "a", 0, 1, 2.0, true))]);
        let value = blocked.to_json();
        for key in ["hausdorff_m", "hausdorff_whole_path_m", "off_path_mean_m", "roll_deg", "pitch_deg"] {
            assert!(value["each"][0]["lap"][key].is_null(), "{key}");
        }
        let of = &value["configurations"]["fixed"];
        assert!(of["roll_deg"]["mean"].is_null() && of["completion"] == 0.0 && of["never_began"] == 1, "{of}");
        assert!(blocked.rows()[0][4..].iter().all(|cell| cell == "–"), "{:?}", blocked.rows());
        assert!(blocked.page().render().contains("spawn blocked"));
        let one = report(vec![run("fixed", "a", 0, 1, 2.0, true)]);
        let of = &one.to_json()["configurations"]["fixed"]["hausdorff_m"];
        assert!(of["mean"] == 2.0 && of["sd"].is_null(), "{of}");
        assert_eq!(one.rows()[0][5], "2.00 ± –");
    }

    #[test]
    fn property_json_keeps_the_contract() {
        let runs = vec![run("fixed", "a", 0, 1, 2.0, false), run("adapted", "a", 0, 1, 1.0, true)];
        let provenance = vec![("command".into(), "nesam navigate".into())];
        let report = NavigationReport { provenance, ..report(runs) };
        let value = report.to_json();
        assert_eq!(value["schema"], "nesam.navigate/1");
        assert_eq!((&value["runs"], &value["laps"]), (&json!(1), &json!(2)), "laps of each configuration, and all");
        assert_eq!(value["each"][1]["file"], "laps/adapted-a-start0-seed1.json");
        for name in ["fixed", "adapted"] {
            let of = &value["configurations"][name];
            assert!(of["completion"].is_number());
            for quantity in ["time_s", "hausdorff_m", "roll_deg", "pitch_deg"] {
                assert!(of[quantity].get("mean").is_some() && of[quantity].get("sd").is_some(), "{name}.{quantity}");
            }
        }
        let whole_m = |configuration: &str| value["configurations"][configuration]["hausdorff_whole_path_m"]["mean"].as_f64();
        assert_eq!([whole_m("fixed"), whole_m("adapted")], [Some(20.0), Some(10.0)]);
        let time_s = &value["configurations"]["fixed"]["time_s"];
        assert!(time_s["mean"].is_null() && time_s["sd"].is_null(), "no lap of `fixed` was completed: {time_s}");
        assert_eq!(value["configurations"]["adapted"]["over_fixed"]["soft"]["hausdorff_m"]["ratio"], 0.5);
        // What somebody who measures the same laps from outside needs.
        for key in ["configuration", "world", "soil", "start", "seed"] {
            assert!(!value["each"][0][key].is_null(), "{key}");
        }
        for key in ["completed", "end", "time_s", "progress", "hausdorff_m", "off_path_mean_m", "roll_deg", "pitch_deg", "scored"] {
            assert!(!value["each"][0]["lap"][key].is_null(), "{key}");
        }
        assert_eq!(value["each"][0]["lap"]["hausdorff_whole_path_m"], 20.0);
        let html = report.page().render();
        assert!(html.contains("path to follow") && html.contains("off_path") && !html.contains("http://"));
    }

    /// Goal: a lap that the plant ended early on is not one that kept to the path. Method: a ditch after a tenth of the distance, beside a lap that was driven out.
    #[test]
    fn regress_laps_that_a_plant_ended_are_in_no_ratio_of_distances() {
        let mut runs = vec![run("fixed", "a", 0, 1, 2.0, true), run("adapted", "a", 0, 1, 0.1, false)];
        runs[1].lap.end = "in a ditch".into();
        let over = |runs: &[Run]| report(runs.to_vec()).to_json()["configurations"]["adapted"]["over_fixed"]["all"].clone();
        let ended = over(&runs);
        assert!(ended["hausdorff_m"].is_null() && ended["off_path_m"].is_null() && ended["roll_deg"]["ratio"] == 1.0, "{ended}");
        runs[1].lap.end = "off_path".into();
        assert_eq!(over(&runs)["hausdorff_m"]["ratio"], 0.05);
    }

    /// Goal: a mean over the whole path is one of all laps or none. Method: a lap that an earlier version has kept among others.
    #[test]
    fn property_no_mean_where_a_lap_does_not_tell_it() {
        let mut runs = vec![run("fixed", "a", 0, 1, 2.0, true), run("fixed", "a", 0, 2, 2.0, true)];
        runs[1].lap.hausdorff_whole_path_m = None;
        let value = report(runs).to_json();
        let fixed = &value["configurations"]["fixed"];
        assert!(fixed["hausdorff_whole_path_m"]["mean"].is_null() && fixed["hausdorff_m"]["mean"] == 2.0, "{fixed}");
    }

    /// Goal: laps on ground of unknown soil are not told among those whose soil is as promised. Method: one of each.
    #[test]
    fn property_unknown_soil_is_a_kind_of_its_own() {
        let known = |soil: SoilKind, seed: u64| Run { soil, ..run("fixed", "a", 0, seed, 2.0, true) };
        let runs = vec![known(SoilKind::Nominal, 1), known(SoilKind::Unknown, 2)];
        let value = report(runs).to_json();
        let kinds = &value["configurations"]["fixed"]["by_soil"];
        assert!(kinds["nominal"]["runs"] == 1 && kinds["unknown"]["runs"] == 1, "{kinds}");
        assert_eq!(value["each"][1]["soil"], "unknown");
    }
}
