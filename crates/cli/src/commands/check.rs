//! `nesam check`: reads everything and says what is wrong.

use std::path::{Path, PathBuf};

use clap::Args;
use nesam_evaluation::Baselines;
use nesam_import::{Doubt, card_doubts, doubts, recorded_doubts};
use nesam_model::bundle::MANIFEST;
use nesam_model::{ModelBundle, Predictor};
use nesam_physics::Vehicle;
use nesam_trajectories::{DataRoot, mass_of_parts_kg, read_vehicle_card_with_notes};
use serde_json::{Value, json};

use crate::args::{DataArgs, SplitArg};
use crate::failure::{Failure, chain};
use crate::on_map;
use crate::output::{check_apart, check_file, say, write_json};
use crate::sources::{beyond_range_note, query};

/// Steps of a second: shorter drives hold no prediction that says something (`nesam import` leaves them out).
const PREDICTED_MIN: usize = 10;

/// Options of `nesam check`.
#[derive(Args, Debug)]
pub struct CheckArgs {
    /// Data roots, bundles, vehicle cards (.json) or configuration files
    #[arg(value_name = "PATH", required = true)]
    paths: Vec<PathBuf>,
    /// Vehicle card, when a data root has none of its own
    #[arg(long, value_name = "FILE")]
    vehicle: Option<PathBuf>,
    /// Also write what was found as JSON (schema nesam.check/1); `-` is standard output
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// What was found, worst first when printed.
#[derive(Default)]
struct Findings {
    errors: Vec<String>,
    doubts: Vec<String>,
    notes: Vec<String>,
}

/// What so many errors and doubts come to.
pub(in crate::commands) fn verdict(errors: usize, doubts: usize) -> String {
    match (errors, doubts) {
        (0, 0) => "sound".into(),
        (0, doubts) => format!("readable; doubts: {doubts}"),
        (errors, _) => format!("errors: {errors}"),
    }
}

impl Findings {
    fn verdict(&self) -> String {
        verdict(self.errors.len(), self.doubts.len())
    }

    fn print(&self, path: &Path, kind: &str) {
        say!("{} ({kind})", path.display());
        for (word, texts) in [("note", &self.notes), ("doubt", &self.doubts), ("error", &self.errors)] {
            texts.iter().for_each(|text| say!("  {word}: {text}"));
        }
        say!("  {}", self.verdict());
    }

    fn to_json(&self, path: &Path, kind: &str) -> Value {
        let path = path.display().to_string();
        json!({ "path": path, "kind": kind, "verdict": self.verdict(), "errors": self.errors, "doubts": self.doubts, "notes": self.notes })
    }

    fn error(&mut self, text: impl Into<String>) {
        self.errors.push(text.into());
    }

    fn doubt(&mut self, place: &str, doubt: &Doubt) {
        self.doubts.push(format!("{place}: {}; {}", doubt.what, doubt.advice));
    }

    fn note(&mut self, text: impl Into<String>) {
        self.notes.push(text.into());
    }
}

/// Runs the command: exit code 2 when anything is wrong. A doubt is no error: what is odd may be true.
pub fn run(args: &CheckArgs) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| check_file(file))?;
    args.json.iter().flat_map(|json| args.paths.iter().map(move |path| [path, json])).try_for_each(check_apart)?;
    let (mut wrong, mut checked) = (0, Vec::new());
    for path in &args.paths {
        let mut findings = Findings::default();
        let kind = check(path, args.vehicle.as_deref(), &mut findings);
        findings.print(path, kind);
        wrong += findings.errors.len();
        checked.push(findings.to_json(path, kind));
    }
    if let Some(file) = &args.json {
        write_json(file, &json!({ "schema": "nesam.check/1", "errors": wrong, "checked": checked }))?;
    }
    if wrong > 0 {
        return Err(Failure::input(format!("the check found errors: {wrong}")));
    }
    Ok(())
}

fn check(path: &Path, card: Option<&Path>, findings: &mut Findings) -> &'static str {
    if path.is_file() && path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json")) {
        vehicle_card(path, findings);
        "vehicle card"
    } else if path.is_file() {
        configuration(path, findings);
        "configuration"
    } else if path.join(MANIFEST).is_file() {
        bundle(path, findings);
        "bundle"
    } else if path.is_dir() {
        data_root(path, card, findings);
        "data root"
    } else {
        findings.error("does not exist");
        "nothing"
    }
}

fn bundle(path: &Path, findings: &mut Findings) {
    let bundle = match ModelBundle::load(path) {
        Ok(bundle) => bundle,
        Err(e) => return findings.error(chain(&e)),
    };
    findings.note(format!("{} {}, vehicle `{}`", bundle.name, bundle.hash, bundle.vehicle.name));
    match bundle.baselines_json.as_deref().map(Baselines::from_json) {
        None => findings.note("carries no fitted baselines; `evaluate` fits them where a set has a train split"),
        Some(Err(e)) => findings.error(chain(&e)),
        Some(Ok(_)) => {}
    }
    if let Err(e) = Predictor::new(std::sync::Arc::new(bundle)) {
        findings.error(chain(&e));
    }
}

fn configuration(path: &Path, findings: &mut Findings) {
    if std::fs::read_to_string(path).is_ok_and(|text| says_nothing(&text)) {
        findings.doubts.push("is empty: every key would have its default; is it the right file?".into());
    }
    match super::serve::check_configuration(path) {
        Ok(doubts) => findings.doubts.extend(doubts),
        Err(failure) => findings.error(failure.to_string()),
    }
}

/// Whether a text is white space and comments.
fn says_nothing(text: &str) -> bool {
    text.lines().map(str::trim).all(|line| line.is_empty() || line.starts_with('#'))
}

fn vehicle_card(path: &Path, findings: &mut Findings) {
    match read_vehicle_card_with_notes(path) {
        Err(e) => findings.error(chain(&e)),
        Ok((vehicle, notes)) => {
            notes.into_iter().for_each(|note| findings.note(note));
            of_card(&vehicle, mass_of_parts_kg(path), findings);
        }
    }
}

fn of_card(vehicle: &Vehicle, mass_of_parts_kg: Option<f64>, findings: &mut Findings) {
    if vehicle.inertia_estimated {
        findings.note(format!("card of `{}` gives no inertia: a box estimate is used", vehicle.name));
    }
    let doubts = card_doubts(vehicle, mass_of_parts_kg);
    doubts.iter().for_each(|doubt| findings.doubt(&format!("card of `{}`", vehicle.name), doubt));
}

fn data_root(path: &Path, card: Option<&Path>, findings: &mut Findings) {
    let root = match DataRoot::open(path, card) {
        Ok(root) => root,
        Err(e) => return findings.error(chain(&e)),
    };
    of_card(root.vehicle(), root.mass_of_parts_kg(), findings);
    if root.sets().is_empty() {
        findings.error("no set: no folder with samples.parquet");
    }
    for set in root.sets() {
        check_set(&root, &set, findings);
    }
    findings.doubts.extend(root.contradictions());
    root.notes().into_iter().for_each(|note| findings.note(note));
}

fn check_set(root: &DataRoot, set: &str, findings: &mut Findings) {
    let args = DataArgs::of(None);
    let drives = match root.load_set(&query(&args, set, SplitArg::All, false)) {
        Ok(drives) => drives,
        Err(e) => return findings.error(format!("set {set}: {}", chain(&e))),
    };
    let samples: usize = drives.iter().map(|d| d.states.len()).sum();
    findings.note(format!("set {set}: {} drives, {samples} samples at {} s", drives.len(), args.dt));
    let recorded = match root.recorded(set) {
        Ok(recorded) => recorded,
        Err(e) => return findings.error(format!("set {set}: {}", chain(&e))),
    };
    let short: Vec<&str> = drives.iter().filter(|d| d.states.len() <= PREDICTED_MIN).map(|d| d.id.as_str()).collect();
    if let Some(first) = short.first() {
        let what = format!(
            "{} of {} drives, as `{first}`, are shorter than a second: nothing can be predicted in them",
            short.len(),
            drives.len()
        );
        findings.doubts.push(format!("set {set}: {what}; leave them out, or join them where they are parts of one drive"));
    }
    let all = recorded_doubts(&recorded).into_iter().chain(doubts(&drives, root.vehicle()));
    all.for_each(|doubt| findings.doubt(&format!("set {set}"), &doubt));
    let mut worlds: Vec<&str> = drives.iter().filter_map(|d| d.world.as_deref()).collect();
    worlds.sort_unstable();
    worlds.dedup();
    for world in &worlds {
        match root.world(world) {
            Err(e) => findings.error(format!("set {set}: world {world}: {}", chain(&e))),
            Ok(map) => {
                let doubts = on_map::doubts(&drives, world, &map, root.vehicle());
                findings.doubts.extend(doubts.into_iter().map(|doubt| format!("set {set}: {doubt}")));
            }
        }
    }
    let without = drives.iter().filter(|d| d.world.is_none()).count();
    if without > 0 {
        findings.note(format!("set {set}: {without} drives have no map: flat ground and the default soil will be used"));
    }
    for beyond in root.beyond_range(&drives) {
        findings.doubts.push(format!("set {set}: {}", beyond_range_note(&beyond)));
    }
}
