//! `nesam predict`: one offline rollout from one instant of a recorded drive.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::{Args, ValueEnum};
use nesam_evaluation::report::{LinePlot, Page, Series};
use nesam_evaluation::{Truth, Window, horizontal_distance, pose_of};
use nesam_model::{MAX_HORIZON, Predictor, Rollout, RolloutQuery, Variant, flag};
use nesam_physics::{Control, SOIL_NAMES, SoilCorrection};
use nesam_terrain::WorldMap;
use nesam_trajectories::commands_from_csv;
use serde_json::{Map, Value, json};

use crate::args::{BundleArgs, CommandsArgs, DataArgs, WindowArgs};
use crate::failure::{Failure, OrFail};
use crate::output;
use crate::output::{note, say};
use crate::sources::{Drives, load_bundle_for, predictor_for, read_drives, rounded};

/// Options of `nesam predict`.
#[derive(Args, Debug)]
pub struct PredictArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    bundle: BundleArgs,
    #[command(flatten)]
    window: WindowArgs,
    #[command(flatten)]
    inputs: CommandsArgs,
    /// Drive to start from [default: the first of the set]
    #[arg(long, value_name = "ID")]
    trajectory: Option<String>,
    /// Instant of the drive at which the prediction starts, s [default: as soon as the history is full, earlier where the drive ends too soon for that]
    #[arg(long, value_name = "SECONDS")]
    at: Option<f64>,
    /// Commands to predict under, CSV with the header speed_m_s,second; as many steps as it has rows, unless --horizon says fewer [default: the recorded
    /// commands]
    #[arg(long, value_name = "FILE.csv")]
    controls: Option<PathBuf>,
    /// Which form of the model
    #[arg(long, value_enum, default_value_t = ModelArg::Nesam)]
    model: ModelArg,
    /// Round the network's products to bf16, as `nesam serve --bf16` does
    #[arg(long)]
    bf16: bool,
    /// Form of the answer on standard output or in --out [default: json, or no further answer where --json or --html says what to write]
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Write the answer here instead of to standard output
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Write the JSON here; `-` is standard output
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the page with plots here
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
enum ModelArg {
    Nesam,
    NesamNoResidual,
    NesamZeroSinkage,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Everything, with provenance.
    Json,
    /// One row per step.
    Csv,
    /// A page with plots of predicted against measured motion.
    Html,
}

impl PredictArgs {
    /// Form of the answer beside the files that have a form of their own; `None` where those are all that is asked for.
    fn answer(&self) -> Option<Format> {
        let only_files = self.out.is_none() && (self.json.is_some() || self.html.is_some());
        self.format.or((!only_files).then_some(Format::Json))
    }
}

/// Runs the command.
pub fn run(args: &PredictArgs) -> Result<(), Failure> {
    output::check_files(args.out.iter().chain(&args.json).chain(&args.html))?;
    args.inputs.check("a prediction is made as the service makes it, under commands alone")?;
    let mut data = args.data.clone();
    if let Some(id) = &args.trajectory {
        data.trajectories = Some(vec![id.clone()]);
    }
    let drives = read_drives(&data, false)?;
    let given = args.controls.as_deref().map(|file| read_controls(file, args.window.horizon)).transpose()?;
    let horizon = given.as_ref().map_or_else(|| args.window.horizon_on(&drives.drives[..1]), Vec::len);
    let window = window(args, &drives, horizon)?;
    let controls = given.map_or_else(|| recorded(&window), Ok)?;
    if controls.len() > MAX_HORIZON {
        return Err(Failure::input(format!("{} steps exceed the model's {MAX_HORIZON}; use a shorter --horizon", controls.len())));
    }
    if let Some(bad) = controls.iter().position(|c| !drives.root.vehicle().admits(c)) {
        let [speed, second] = drives.root.vehicle().command_range;
        let [of_speed, of_second] = drives.root.implied_range().map(|implied| if implied { " (implied, not stated)" } else { "" });
        return Err(Failure::input(format!(
            "command {bad} (speed {} m/s, second {}) is outside the card's range: speed {speed:?} m/s{of_speed}, second {second:?}{of_second}; \
             `command_range` of a card states it, and `nesam calibrate` widens an implied one to the commands of the drives",
            controls[bad].speed_m_s, controls[bad].second
        )));
    }
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
    let predictor = rounded(predictor, args.bf16, "--bf16")?;
    let map = drives.maps[0].as_ref();
    let rollout = rollout(args, &predictor, &window, &controls, map)?;
    let text = |format: Format| match format {
        Format::Json => as_json(&drives, &predictor, &window, &controls, &rollout),
        Format::Csv => as_csv(&window, &controls, &rollout),
        Format::Html => as_html(&drives, &predictor, &window, &rollout),
    };
    let answer = args.answer();
    let files = [(&args.json, Some(Format::Json)), (&args.html, Some(Format::Html)), (&args.out, answer)];
    for (file, format) in files.into_iter().filter_map(|(file, format)| file.as_ref().zip(format)) {
        output::write_file(file, text(format).as_bytes())?;
        note!("wrote {}", file.display());
    }
    if let (Some(format), None) = (answer, &args.out) {
        say!("{}", text(format).trim_end());
    }
    Ok(())
}

/// The window that the options name. Without `--controls` it must lie in the drive whole.
fn window<'a>(args: &PredictArgs, drives: &'a Drives, horizon: usize) -> Result<Window<'a>, Failure> {
    let drive = &drives.drives[0];
    let last = drive.states.len() - 1;
    let recorded_steps = if args.controls.is_none() { horizon } else { 0 };
    let start = match args.at {
        None => (args.window.history.max(1) - 1).min(last.saturating_sub(recorded_steps)),
        Some(at) => {
            let end = drive.time_s[last];
            if !at.is_finite() || at < drive.time_s[0] || at > end {
                return Err(Failure::input(format!("--at {at} lies outside drive `{}`, {}…{end} s", drive.id, drive.time_s[0])));
            }
            let start = drive.time_s.iter().rposition(|t| *t <= at + 1e-6).unwrap_or(0);
            if at - drive.time_s[start] > 1e-3 {
                note!("note: the prediction starts at the sample before --at {at}, at {:.3} s", drive.time_s[start]);
            }
            start
        }
    };
    let first_history = (start + 1).saturating_sub(args.window.history);
    Ok(Window { trajectory: drive, drive: 0, start, first_history, horizon })
}

fn recorded(window: &Window<'_>) -> Result<Vec<Control<f64>>, Failure> {
    let drive = window.trajectory;
    drive.controls.get(window.start..window.start + window.horizon).map(<[_]>::to_vec).ok_or_else(|| {
        Failure::input(format!(
            "drive `{}` ends {} steps after {:.1} s, too soon for {}; start earlier with --at, predict fewer with --horizon, or give --controls",
            drive.id,
            drive.states.len() - 1 - window.start,
            window.start_time_s(),
            window.horizon
        ))
    })
}

/// Reads commands, no more than `horizon` where one is asked for; errors name file, line and what was expected.
fn read_controls(file: &Path, horizon: Option<usize>) -> Result<Vec<Control<f64>>, Failure> {
    let named = |reason: &dyn std::fmt::Display| Failure::input(format!("{}: {reason}", file.display()));
    let text = std::fs::read_to_string(file).map_err(|error| named(&error))?;
    let mut controls = commands_from_csv(&text).map_err(|reason| named(&reason))?;
    if let Some(horizon) = horizon.filter(|horizon| *horizon > controls.len()) {
        return Err(named(&format!(
            "has {} commands and --horizon asks for {horizon} steps; give a command for each or a shorter --horizon",
            controls.len()
        )));
    }
    if let Some(horizon) = horizon.filter(|horizon| *horizon < controls.len()) {
        note!("note: the first {horizon} of {} commands in {} are used, as --horizon says", controls.len(), file.display());
        controls.truncate(horizon);
    }
    Ok(controls)
}

fn rollout(
    args: &PredictArgs,
    predictor: &Predictor,
    window: &Window<'_>,
    controls: &[Control<f64>],
    map: Option<&Arc<WorldMap>>,
) -> Result<Rollout, Failure> {
    let packed: Vec<f32> = controls.iter().flat_map(Control::packed).collect();
    let variant = match args.model {
        ModelArg::Nesam => Variant::Full,
        ModelArg::NesamNoResidual => Variant::NoResidual,
        ModelArg::NesamZeroSinkage => Variant::ZeroSinkage,
    };
    let query = RolloutQuery {
        history: &window.history(),
        start: window.trajectory.states[window.start],
        controls: &packed,
        samples: 1,
        horizon: controls.len(),
        map,
        soil_correction: SoilCorrection::NONE,
        variant,
        start_time_s: Some(window.since_log_start_s()),
        wheels: None,
    };
    predictor.rollout_on(&query, &query.soil_correction).or_failed()
}

const STATE_KEYS: [&str; 12] =
    ["x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad", "vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s"];

fn named(values: impl IntoIterator<Item = f64>) -> Value {
    Value::Object(STATE_KEYS.iter().zip(values).map(|(k, v)| ((*k).to_string(), json!(v))).collect::<Map<_, _>>())
}

/// Names of the validity bits that are set.
fn flag_names(word: u32) -> Vec<&'static str> {
    let names = [
        (flag::NOT_FINITE, "not_finite"),
        (flag::OFF_MAP, "off_map"),
        (flag::NO_MAP, "no_map"),
        (flag::SPEED_UNTRAINED, "speed_untrained"),
        (flag::STEERING_UNTRAINED, "steering_untrained"),
        (flag::SLOPE_UNTRAINED, "slope_untrained"),
        (flag::OVERTURNED, "overturned"),
        (flag::START_OFF_GROUND, "start_off_ground"),
    ];
    names.into_iter().filter(|(bit, _)| word & bit != 0).map(|(_, name)| name).collect()
}

fn as_json(drives: &Drives, predictor: &Predictor, window: &Window<'_>, controls: &[Control<f64>], rollout: &Rollout) -> String {
    let drive = window.trajectory;
    let steps: Vec<Value> = (0..rollout.horizon)
        .map(|k| {
            let measured = drive.states.get(window.start + k + 1).map(|s| named(s.to_array()));
            json!({
                "k": k + 1,
                "t_s": window.start_time_s() + (k + 1) as f64 * drive.dt_s,
                "command": {"speed_m_s": controls[k].speed_m_s, "second": controls[k].second},
                "state": named(rollout.state_f64(0, k).to_array()),
                "sinkage_m": rollout.sinkage(0, k),
                "measured": measured,
            })
        })
        .collect();
    let soil: Map<String, Value> = SOIL_NAMES.iter().zip(rollout.soil).map(|(k, v)| ((*k).to_string(), json!(v))).collect();
    let document = json!({
        "schema": "nesam.predict/1",
        "set": drives.set,
        "trajectory": drive.id,
        "t0_s": window.start_time_s(),
        "dt_s": drive.dt_s,
        "history_steps": window.start - window.first_history + 1,
        "start": named(drive.states[window.start].to_array()),
        "soil": soil,
        "flags": flag_names(rollout.flags[0]),
        "steps": steps,
        "provenance": output::provenance(Some(predictor.bundle()), drives),
    });
    output::json_text(&document)
}

fn as_csv(window: &Window<'_>, controls: &[Control<f64>], rollout: &Rollout) -> String {
    let sinkage = ["sinkage_fl_m", "sinkage_fr_m", "sinkage_rl_m", "sinkage_rr_m"];
    let mut text = format!("k,t_s,cmd_speed_m_s,cmd_second,{},{}\n", STATE_KEYS.join(","), sinkage.join(","));
    for (k, command) in controls.iter().enumerate() {
        let t = window.start_time_s() + (k + 1) as f64 * window.trajectory.dt_s;
        let position = rollout.state_f64(0, k).position_m.map(|v| v.to_string());
        let rest = rollout.state(0, k).to_array().into_iter().skip(3).chain(rollout.sinkage(0, k)).map(|v| v.to_string());
        let numbers: Vec<String> = position.into_iter().chain(rest).collect();
        text += &format!("{},{t},{},{},{}\n", k + 1, command.speed_m_s, command.second, numbers.join(","));
    }
    text
}

fn as_html(drives: &Drives, predictor: &Predictor, window: &Window<'_>, rollout: &Rollout) -> String {
    let drive = window.trajectory;
    let start = window.start_pose();
    let predicted: Vec<_> = (0..rollout.horizon).map(|k| pose_of(&rollout.state_f64(0, k))).collect();
    let covered = window.horizon.min(drive.states.len() - 1 - window.start);
    let measured = Window { horizon: covered, ..*window }.truth(Truth::Measured);
    let last_error = covered.checked_sub(1).map_or(f64::NAN, |k| horizontal_distance(&predicted[k], &measured[k]));
    let lead = format!(
        "One rollout of {} steps from {:.1} s of drive {}: horizontal error against the measured motion {last_error:.3} m at the last measured step.",
        rollout.horizon,
        window.start_time_s(),
        drive.id
    );
    let mut page = Page::new(&format!("nesam predict: {}", drive.id), &lead);
    let path = |poses: &[nesam_evaluation::Pose]| std::iter::once((start[0], start[1])).chain(poses.iter().map(|p| (p[0], p[1]))).collect();
    let mut plan = LinePlot::new("path", "x [m]", "y [m]");
    plan.equal_aspect = true;
    plan.series = vec![Series::line("measured", 0, path(&measured)), Series::line("predicted", 1, path(&predicted))];
    plan.series[0].mark_start = true;
    let mut plots = vec![plan];
    for (d, (name, unit)) in [("z", "m"), ("roll", "deg"), ("pitch", "deg"), ("yaw", "deg")].into_iter().enumerate() {
        let of = |poses: &[nesam_evaluation::Pose]| -> Vec<(f64, f64)> {
            let value = |p: &nesam_evaluation::Pose| if d == 0 { p[2] } else { p[d + 2].to_degrees() };
            let from_start = std::iter::once((0.0, value(&start)));
            from_start.chain(poses.iter().enumerate().map(|(k, p)| ((k + 1) as f64 * drive.dt_s, value(p)))).collect()
        };
        let mut plot = LinePlot::new(name, "time ahead [s]", &format!("{name} [{unit}]"));
        plot.series = vec![Series::line("measured", 0, of(&measured)), Series::line("predicted", 1, of(&predicted))];
        plots.push(plot);
    }
    page.section("Motion").plots(&plots, "Measured and predicted motion from the same start; hover for values.");
    let soil = SOIL_NAMES.iter().zip(rollout.soil).map(|(n, v)| format!("{n} {v:.4}")).collect::<Vec<_>>().join(", ");
    page.section("Soil and validity").text(&format!("Soil used under the start (SI, rad): {soil}.")).text(&format!(
        "Validity: {}.",
        if rollout.flags[0] == 0 { "nothing to say against this prediction".into() } else { flag_names(rollout.flags[0]).join(", ") }
    ));
    page.made_from(&output::provenance(Some(predictor.bundle()), drives));
    page.render()
}
