//! `nesam bench alarms`: how often sessions alarm for nothing, and how soon after something.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use clap::Args;
use nesam_discovery::bench::{Change, apply};
use nesam_engine::{Alarm, AlarmKind, Command, Engine, Event, Limits, Measurement, OpenSession, WheelMeasurement};
use nesam_evaluation::median;
use nesam_model::Predictor;
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::args::{BundleArgs, DataArgs, SplitArg};
use crate::failure::{Failure, OrFail};
use crate::interrupt::exit_on_ctrl_c;
use crate::output::{check_file, provenance, say, write_json};
use crate::sources::{load_bundle_for, predictor_for, read_drives, validation_drives};

/// Options of `nesam bench alarms`.
#[derive(Args, Debug)]
pub(super) struct AlarmBench {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    bundle: BundleArgs,
    /// Also hide effects in the second half of each drive: how many are seen, by which test, how soon
    #[arg(long)]
    hide: bool,
    /// Write the figures as JSON (schema nesam.bench.alarms/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// What is hidden from the middle of the drives on.
const HIDDEN: [(&str, Change); 14] = [
    ("gyro_bias 0.005 rad/s", Change::GyroBias(0.005)),
    ("gyro_bias 0.02 rad/s", Change::GyroBias(0.02)),
    ("gyro_scale 0.05", Change::GyroScale(0.05)),
    ("velocity_scale 0.02", Change::VelocityScale(0.02)),
    ("velocity_scale 0.05", Change::VelocityScale(0.05)),
    ("lever_arm 0.4 m", Change::LeverArm(0.4)),
    ("mount_angle 0.02 rad", Change::MountRoll(0.02)),
    ("speed_gain 0.05", Change::SpeedGain(0.05)),
    ("speed_gain 0.1", Change::SpeedGain(0.1)),
    ("speed_gain 0.2", Change::SpeedGain(0.2)),
    ("steering_offset 0.08", Change::SteeringOffset(0.08)),
    ("steering_offset 0.16", Change::SteeringOffset(0.16)),
    ("steering_delay 0.3 s", Change::SteeringDelay(0.3)),
    ("noise ×2", Change::Noise(1.0)),
];

/// Runs the command.
pub(super) fn run(args: &AlarmBench) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| check_file(file))?;
    exit_on_ctrl_c("nothing was written");
    let drives = match args.data.split {
        SplitArg::Train => validation_drives(&args.data, "bench alarms", "alarms are counted")?,
        _ => read_drives(&args.data, false)?,
    };
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
    if predictor.bundle().soil_filter_json.is_none() {
        return Err(Failure::input(
            "sessions of this bundle are not watched: it has no calibrated soil filter (`nesam adapt --calibrate`)",
        ));
    }
    let pairs: Vec<(&Trajectory, &Option<Arc<WorldMap>>)> = drives.drives.iter().zip(&drives.maps).collect();
    let hours = pairs.iter().map(|(d, _)| d.time_s.last().copied().unwrap_or(0.0)).sum::<f64>() / 3600.0;
    let quiet: Vec<Vec<Alarm>> = pairs.par_iter().map(|(drive, map)| alarms(&predictor, drive, map.as_ref())).collect::<Result<_, _>>()?;
    let false_alarms = counted(&pairs, &quiet, hours);
    let mut hidden = Vec::new();
    if args.hide {
        say!("\n{:<24}{:>8}{:>8}{:>10}{:>10}{:>12}  {}", "from the middle on", "drives", "seen", "before", "delay s", "onset off s", "by");
        for (name, change) in HIDDEN {
            hidden.push(seen(&predictor, &pairs, name, change)?);
        }
    }
    let Some(file) = &args.json else { return Ok(()) };
    let document = json!({
        "schema": "nesam.bench.alarms/1",
        "set": drives.set,
        "unchanged": false_alarms,
        "hidden": hidden,
        "provenance": provenance(Some(predictor.bundle()), &drives),
    });
    write_json(file, &document)
}

/// Prints and gives the alarms of drives in which nothing was hidden.
fn counted(pairs: &[(&Trajectory, &Option<Arc<WorldMap>>)], quiet: &[Vec<Alarm>], hours: f64) -> Value {
    let raised: Vec<(&str, &Alarm)> =
        pairs.iter().zip(quiet).flat_map(|((d, _), alarms)| alarms.iter().filter(|a| a.active).map(|a| (d.id.as_str(), a))).collect();
    let mut kinds: BTreeMap<&str, usize> = AlarmKind::ALL.iter().map(|kind| (kind.label(), 0)).collect();
    for (_, alarm) in &raised {
        *kinds.entry(alarm.kind.label()).or_default() += 1;
    }
    let with_one = quiet.iter().filter(|alarms| !alarms.is_empty()).count();
    say!(
        "{} drives, {:.1} min: {} alarms in {with_one} drives, {:.1} per hour; {}",
        pairs.len(),
        60.0 * hours,
        raised.len(),
        raised.len() as f64 / hours,
        kinds.iter().map(|(kind, count)| format!("{kind} {count}")).collect::<Vec<_>>().join(", ")
    );
    for (drive, alarm) in &raised {
        let (at, onset) = (seconds(alarm.stamp_ns), seconds(alarm.onset_ns));
        say!("  {drive:<8} {:<12} at {at:5.1} s since {onset:5.1} s: {}", alarm.kind.label(), alarm.description());
    }
    let list: Vec<Value> = raised
        .iter()
        .map(|(drive, a)| {
            json!({"drive": drive, "kind": a.kind.label(), "channel": a.channel_name(), "statistic": a.statistic, "stamp_s": seconds(a.stamp_ns),
                "onset_s": seconds(a.onset_ns), "soil_share": a.soil_share})
        })
        .collect();
    json!({"drives": pairs.len(), "hours": hours, "alarms": raised.len(), "kinds": kinds, "list": list})
}

/// Prints and gives what became of a change that was hidden in the second half of the drives.
fn seen(predictor: &Arc<Predictor>, pairs: &[(&Trajectory, &Option<Arc<WorldMap>>)], name: &str, change: Change) -> Result<Value, Failure> {
    let told: Vec<(f64, Vec<Alarm>)> = pairs
        .par_iter()
        .map(|(drive, map)| {
            let mut changed = (*drive).clone();
            let onset_s = drive.dt_s * (drive.states.len() / 2) as f64;
            apply(change, onset_s, &mut changed, None);
            hold(&mut changed, predictor.bundle().vehicle.command_range);
            Ok((onset_s, alarms(predictor, &changed, map.as_ref())?))
        })
        .collect::<Result<_, Failure>>()?;
    let early = |onset_s: f64, alarm: &&Alarm| alarm.active && seconds(alarm.stamp_ns) <= onset_s;
    let before = told.iter().map(|(onset_s, alarms)| alarms.iter().filter(|a| early(*onset_s, a)).count()).sum::<usize>();
    let first = |(onset_s, alarms): &(f64, Vec<Alarm>)| {
        alarms
            .iter()
            .find(|a| a.active && seconds(a.stamp_ns) > *onset_s)
            .map(|a| (*a, seconds(a.stamp_ns) - onset_s, seconds(a.onset_ns) - onset_s))
    };
    let firsts: Vec<(Alarm, f64, f64)> = told.iter().filter_map(first).collect();
    let mut kinds: BTreeMap<&str, usize> = BTreeMap::new();
    for (alarm, ..) in &firsts {
        *kinds.entry(alarm.kind.label()).or_default() += 1;
    }
    let middle = |of: &dyn Fn(&(Alarm, f64, f64)) -> f64| (!firsts.is_empty()).then(|| median(&firsts.iter().map(of).collect::<Vec<_>>()));
    let (delay, off) = (middle(&|f| f.1), middle(&|f| f.2.abs()));
    let show = |v: Option<f64>| v.map_or("–".to_string(), |v| format!("{v:.1}"));
    let by = kinds.iter().map(|(kind, count)| format!("{kind} {count}")).collect::<Vec<_>>().join(", ");
    say!("{name:<24}{:>8}{:>8}{before:>10}{:>10}{:>12}  {by}", pairs.len(), firsts.len(), show(delay), show(off));
    Ok(json!({"hidden": name, "drives": pairs.len(), "seen": firsts.len(), "alarms_before": before, "delay_median_s": delay,
        "onset_error_median_s": off, "kinds": kinds}))
}

/// Keeps changed commands within the card: no vehicle is told more than that, so at full lock less of an effect is hidden than its name says.
fn hold(drive: &mut Trajectory, [speed_m_s, second]: [[f64; 2]; 2]) {
    for command in &mut drive.controls {
        command.speed_m_s = command.speed_m_s.clamp(speed_m_s[0], speed_m_s[1]);
        command.second = command.second.clamp(second[0], second[1]);
    }
}

/// Everything that a session is told by its watch when a drive is fed to it.
fn alarms(predictor: &Arc<Predictor>, drive: &Trajectory, map: Option<&Arc<WorldMap>>) -> Result<Vec<Alarm>, Failure> {
    let heard = Arc::new(Mutex::new(Vec::new()));
    let sink = Arc::clone(&heard);
    let mut engine = Engine::new(Arc::clone(predictor), Limits::default()).or_input()?.with_events(Box::new(move |event| {
        if let (Event::AlarmChanged { alarm, .. }, Ok(mut heard)) = (event, sink.lock()) {
            heard.push(*alarm);
        }
    }));
    if let Some(map) = map {
        engine.execute(0, &Command::PutMap { map: Arc::clone(map), base: None }).or_failed()?;
    }
    let map = map.map(|map| map.id().to_string()).unwrap_or_default();
    let open = OpenSession { vehicle: "vehicle".into(), map, ..OpenSession::default() };
    engine.execute(0, &Command::Open(open)).or_failed()?;
    for (i, (state, command)) in drive.states.iter().zip(&drive.controls).enumerate() {
        let stamp_ns = (drive.time_s[i] * 1e9).round() as i64;
        let measurement =
            Measurement { sequence: None, boot: None, stamp_ns, state: *state, command: *command, wheels: WheelMeasurement::default() };
        let command = Command::Measure { session: "vehicle".into(), vehicle: None, measurement };
        engine.execute(u64::try_from(stamp_ns).unwrap_or(0), &command).or_failed()?;
    }
    drop(engine);
    Ok(heard.lock().map(|heard| heard.clone()).unwrap_or_default())
}

fn seconds(stamp_ns: i64) -> f64 {
    stamp_ns as f64 * 1e-9
}
