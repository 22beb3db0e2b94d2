//! The drives of a diagnosis from what a server recorded of one session: what an alarm asks for.

use std::path::PathBuf;

use clap::Args;
use nesam_engine::{AppliedEffect, Measurement};
use nesam_evaluation::report::Short;
use nesam_model::ModelBundle;
use nesam_model::bundle::sha256_hex;
use nesam_server::recording::{RecordedWindow, Recording, RecordingError, RecordingHeader, window};
use nesam_trajectories::{Report, drives_of_reports, has_a_piece};

use super::{Input, ReferenceArg, reference};
use crate::args::BundleArgs;
use crate::failure::{Failure, OrFail};
use crate::output::{self, note};
use crate::sources::{load_recorded_bundle, maps_hash};

/// Pieces of a recording that stand for drives.
const PIECES: usize = 5;
/// The same where the model itself is tested, of which effects are claimed by eight drives or more: pauses cut unevenly.
const PIECES_OF_THE_MODEL: usize = 10;

/// Options that take the drives from a recording.
#[derive(Args, Debug)]
pub struct RecordingArgs {
    /// Diagnose what a server recorded of a session instead of a set: files of recordings, or their folder; of several it is the newest that has
    /// enough of the session in the window. Without --bundle it is the recorded bundle, found by its hash in deploy/bundles
    #[arg(long, value_name = "PATH", num_args = 1.., requires = "session", conflicts_with_all = ["data", "set", "trajectories", "vehicle", "dt"])]
    pub recording: Vec<PathBuf>,
    /// Session to diagnose
    #[arg(long, value_name = "ID", requires = "recording")]
    session: Option<String>,
    /// First stamp of the window, ns of the vehicle's clock [default: the first]
    #[arg(long, value_name = "NS", requires = "recording", allow_negative_numbers = true, default_value_t = i64::MIN, hide_default_value = true)]
    from_ns: i64,
    /// Last stamp of the window, ns of the vehicle's clock [default: the last]
    #[arg(long, value_name = "NS", requires = "recording", allow_negative_numbers = true, default_value_t = i64::MAX, hide_default_value = true)]
    to_ns: i64,
    /// Pieces that stand for drives. They share ground and driver, so the evidence is weaker than that of as many drives [default: 5; 10 where the
    /// model itself is tested, which claims effects by eight or more]
    #[arg(long, value_name = "N", requires = "recording")]
    pieces: Option<usize>,
}

impl RecordingArgs {
    /// Refuses parts of a recording where none is given: the parser lets them pass beside a set, which a recording excludes.
    pub fn check(&self) -> Result<(), Failure> {
        let of_recording =
            [("--session", self.session.is_some()), ("--from-ns", self.from_ns != i64::MIN), ("--to-ns", self.to_ns != i64::MAX)];
        match of_recording.into_iter().find(|(_, given)| *given && self.recording.is_empty()) {
            Some((option, _)) => Err(Failure::input(format!("{option} is for --recording, and a set was given"))),
            None if self.from_ns > self.to_ns => {
                Err(Failure::input(format!("--from-ns {} is behind --to-ns {}", self.from_ns, self.to_ns)))
            }
            None => Ok(()),
        }
    }

    /// The pieces of the window in steps of the model, with the map of the session.
    pub fn input(&self, bundle: &BundleArgs, asked: Option<ReferenceArg>) -> Result<Input, Failure> {
        let session = self.session.as_deref().unwrap_or_default();
        let recordings = Recording::open_all(&self.recording).or_input()?;
        let (header, window) = self.newest_with(session, recordings)?;
        let bundle = recorded_bundle(bundle, &header)?;
        let pieces = self.pieces.unwrap_or(match reference(asked, &bundle) {
            ReferenceArg::Bundle => PIECES,
            ReferenceArg::Physics => PIECES_OF_THE_MODEL,
        });
        let reports = reports(&window);
        let drives = drives_of_reports(session, &reports, bundle.normalization.dt_s, pieces);
        if drives.is_empty() {
            return Err(Failure::input(format!("session `{session}` has no 4 s of measurements without a pause in this window")));
        }
        let seconds: f64 = drives.iter().map(|d| d.time_s.last().copied().unwrap_or(0.0)).sum();
        let of_pieces = format!(
            "session {session}: {} measurements, {seconds:.1} s in {} pieces of one recording; pieces share ground and driver, so this is weaker evidence than \
             that many drives",
            reports.len(),
            drives.len()
        );
        let notes: Vec<String> = [of_pieces].into_iter().chain(applied_note(session, &window.applied)).collect();
        notes.iter().for_each(|text| note!("note: {text}"));
        let numbers = reports.iter().flat_map(|r| r.state.to_array().into_iter().chain([r.time_s, r.command.speed_m_s, r.command.second]));
        let data_hash = sha256_hex(&numbers.flat_map(f64::to_le_bytes).collect::<Vec<u8>>());
        let maps = vec![window.map; drives.len()];
        let provenance = output::provenance_of(Some(&bundle), &data_hash, &maps_hash(&maps));
        let predictor = std::sync::Arc::new(nesam_model::Predictor::new(std::sync::Arc::new(bundle)).or_input()?);
        Ok(Input { set: format!("recording-{session}"), drives, maps, data_hash, predictor, provenance, short: Vec::new(), notes })
    }

    /// What a session measured in the newest recording that has enough of it in the window for a diagnosis; where none has, the newest with something, else
    /// what the newest says.
    fn newest_with(&self, session: &str, recordings: Vec<Recording>) -> Result<(RecordingHeader, RecordedWindow), Failure> {
        let count = recordings.len();
        let (mut found, mut otherwise) = (None, None);
        for mut recording in recordings.into_iter().rev() {
            let header = recording.header().clone();
            match window(&mut recording, session, self.from_ns, self.to_ns) {
                Ok(window) if has_a_piece(&reports(&window)) => {
                    found = Some((header, window));
                    break;
                }
                Ok(window) if !window.measurements.is_empty() => found = found.or(Some((header, window))),
                Ok(window) => otherwise = otherwise.or(Some(Ok((header, window)))),
                Err(error @ RecordingError::NoSession { .. }) => otherwise = otherwise.or(Some(Err(error))),
                Err(error) => return Err(error).or_input(),
            }
        }
        if let Some((header, window)) = found {
            if count > 1 {
                note!("note: {} is diagnosed, of {count} recordings the newest with enough of this session in the window", header.run);
            }
            return Ok((header, window));
        }
        otherwise.expect("there is at least one recording; this is a bug").or_input()
    }
}

/// What effects that were applied to a session mean for its diagnosis.
fn applied_note(session: &str, applied: &[AppliedEffect]) -> Option<String> {
    let one = |effect: &AppliedEffect| {
        let values: Vec<String> = effect.parameters.iter().map(|p| format!("{}={}", p.name, Short(p.value))).collect();
        format!("{}:{}", effect.id, values.join(","))
    };
    let effects: Vec<String> = applied.iter().map(one).collect();
    (!effects.is_empty()).then(|| {
        format!(
            "the session predicts with {} applied; this is measured against the bundle alone, so that what is found takes the place of that, and where \
             nothing is found it is to be taken away (`nesam effects revert --session={session}`)",
            effects.join(" ")
        )
    })
}

/// The bundle of the recording, or the given one where it is of the same vehicle.
fn recorded_bundle(args: &BundleArgs, header: &RecordingHeader) -> Result<ModelBundle, Failure> {
    let bundle = load_recorded_bundle(args.bundle.as_deref(), header)?;
    if bundle.vehicle.name != header.vehicle {
        return Err(Failure::input(format!(
            "bundle {} was trained for `{}`, the recording is of `{}`; give a bundle of that vehicle with --bundle DIR",
            bundle.name, bundle.vehicle.name, header.vehicle
        )));
    }
    if bundle.hash != header.bundle_hash {
        note!(
            "note: the recording was made with bundle {} {}; {} {} is diagnosed",
            header.bundle,
            header.bundle_hash,
            bundle.name,
            bundle.hash
        );
    }
    Ok(bundle)
}

fn reports(window: &RecordedWindow) -> Vec<Report> {
    window.measurements.iter().map(report).collect()
}

fn report(m: &Measurement) -> Report {
    Report {
        time_s: m.stamp_ns as f64 * 1e-9,
        state: m.state,
        command: m.command,
        wheel_speed_rad_s: m.wheels.speed_rad_s,
        road_wheel_angle_rad: m.wheels.road_wheel_angle_rad,
    }
}
