//! `nesam bench predict`: the queries of a sampling planner, in process and end to end.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use clap::Args;
use nesam_evaluation::{Pose, Truth, absolute_error, all_windows, history_steps, horizontal_distance, roll_out};
use nesam_model::reference::ComputeDevice;
use nesam_model::{HISTORY, HistoryStep, MAX_HORIZON, Precision, Predictor, Rollout, RolloutQuery, Variant};
use nesam_physics::{Control, SoilCorrection};
use nesam_terrain::WorldMap;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;

use super::{QUERIES_MAX, page, percentile, sweep};
use crate::args::{BundleArgs, DataArgs, check_count};
use crate::failure::{Failure, OrFail};
use crate::interrupt::exit_on_ctrl_c;
use crate::output::{check_files, note, provenance, say, write_file, write_json};
use crate::progress::Progress;
use crate::sources::{Drives, load_bundle_for, predictor_for, read_drives};

/// Options of `nesam bench predict`.
#[derive(Args, Debug)]
pub(super) struct PredictBench {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    bundle: BundleArgs,
    /// Candidate command sequences per query
    #[arg(long, default_value_t = 1024)]
    samples: usize,
    /// Steps per rollout
    #[arg(long, value_name = "STEPS", default_value_t = 32)]
    horizon: usize,
    /// Timed queries of each kind
    #[arg(long, default_value_t = 30)]
    queries: usize,
    /// Seed of poses and commands
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Instructions to run on: avx512, or avx2 (portable where the build has no AVX2), or for products of bf16 amx or avx512-bf16 [default: the fastest of
    /// this processor in f32]
    #[arg(long, value_name = "NAME")]
    path: Option<String>,
    /// Also time 64 to 2048 candidates on every path of this processor, terrain warm
    #[arg(long)]
    sweep: bool,
    /// Also say where the time goes: lookup, network, physics, the rest
    #[arg(long)]
    parts: bool,
    /// Also time the reference, which is made of candle tensors, on a device: cpu, or cuda in a program built with that feature; may be given twice
    #[arg(long, value_name = "DEVICE")]
    reference: Vec<ComputeDevice>,
    /// Write the figures as JSON (schema nesam.bench/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the figures as a page with plots
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
}

/// Candidates of a query at most: their states are 1.5 kB each.
const SAMPLES_MAX: usize = 1 << 18;
/// Memory of the commands' noise from step to step, as sampling planners draw it.
const NOISE_MEMORY: f32 = 0.8;
/// Standard deviation of the noise: speed, m/s, and share of the second command's range.
const NOISE_SD: [f32; 2] = [0.5, 0.3];
/// Starts that queries need at least.
const STARTS_MIN: usize = 8;
/// Windows on which the cached terrain is held against the exact one.
const CHECKED_WINDOWS: usize = 24;

/// Runs the command.
pub(super) fn run(args: &PredictBench) -> Result<(), Failure> {
    check_files(args.json.iter().chain(&args.html))?;
    check_count("--samples", args.samples, 1..=SAMPLES_MAX)?;
    check_count("--queries", args.queries, 1..=QUERIES_MAX)?;
    check_count("--horizon", args.horizon, 1..=MAX_HORIZON)?;
    exit_on_ctrl_c("nothing was written");
    let drives = read_drives(&args.data, false)?;
    let bundle = load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?;
    let drive = Planner::new(&drives, args)?;
    let progress = Progress::start("queries", 3 * args.queries);
    let mut done = 0;
    let mut time = |predictor: &Predictor, at: usize, seed: u64| -> Result<f64, Failure> {
        let controls = drive.controls(at, seed);
        let began = Instant::now();
        drive.ask(predictor, at, &controls)?;
        done += 1;
        progress.set(done);
        Ok(began.elapsed().as_secs_f64() * 1e3)
    };

    // One replan after the other along the drive at the rate of the model, on a map that nobody has asked about yet.
    let chosen = sweep::on_path(predictor_for(bundle.clone(), &drives.root, args.data.dt)?, args.path.as_deref())?;
    let fresh: &Predictor = &chosen;
    let steady = (0..args.queries).map(|q| time(fresh, drive.along(q), args.seed + q as u64)).collect::<Result<Vec<_>, _>>()?;
    // Poses all over the drive whose surroundings have been asked about before, with other commands.
    let warm_up =
        (0..args.queries).map(|q| time(fresh, drive.anywhere(q, args.queries), 1000 + q as u64)).collect::<Result<Vec<_>, _>>()?;
    let before = drive.map.as_ref().map(|map| fresh.terrain_cache(map));
    let processor_before = processor_time_ms();
    let mut warm =
        (0..args.queries).map(|q| time(fresh, drive.anywhere(q, args.queries) + 1, 2000 + q as u64)).collect::<Result<Vec<_>, _>>()?;
    let processor_ms = processor_time_ms().zip(processor_before).map(|(after, before)| (after - before) / args.queries as f64);
    let hit_rate = drive.map.as_ref().zip(before).map(|(map, before)| fresh.terrain_cache(map).since(before).hit_rate());
    progress.finish();

    let mut later: Vec<f64> = steady[1..].to_vec();
    let p50 = percentile(&mut warm, 0.5);
    let steady_p50 = if later.is_empty() { steady[0] } else { percentile(&mut later, 0.5) };
    let max_error = share_of_error(&drives, [fresh, &fresh.exactly()], args.horizon)?;
    let rounding = match fresh.precision() {
        Precision::F32 => None,
        Precision::Bf16(_) => share_of_error(&drives, [fresh, &fresh.in_precision(Precision::F32)], args.horizon)?,
    };
    let made_from = provenance(Some(&bundle), &drives);
    let figures = json!({
        "schema": "nesam.bench/1",
        "samples": args.samples,
        "horizon": args.horizon,
        "path": fresh.path().as_str(),
        "threads": rayon::current_num_threads(),
        "queries": args.queries,
        "p50_ms": p50,
        "p99_ms": percentile(&mut warm, 0.99),
        "min_ms": percentile(&mut warm, 0.0),
        "processor_ms": processor_ms,
        "cold_ms": steady[0],
        "warm_up_max_ms": warm_up.iter().copied().fold(0.0, f64::max),
        "tokens_per_s": (args.samples * args.horizon) as f64 / (p50 * 1e-3),
        "steady_p50_ms": steady_p50,
        "terrain_cache": {"hit_rate": hit_rate, "max_error": max_error},
        "rounding_max_error": rounding,
        "parts_ms": args.parts.then(|| sweep::parts(&drive, fresh)).transpose()?,
        "reference": sweep::reference(&drive, fresh, &args.reference)?,
        "sweep": args.sweep.then(|| sweep::sweep(&drive, fresh)).transpose()?,
        "provenance": made_from,
    });
    say!(
        "{} candidates x {} steps on the {} path, {} threads, {} queries",
        args.samples,
        args.horizon,
        fresh.path().as_str(),
        rayon::current_num_threads(),
        args.queries
    );
    say!("  warm, new pose and new commands each   p50 {p50:9.1} ms   p99 {:9.1} ms", percentile(&mut warm, 0.99));
    if let Some(processor_ms) = processor_ms {
        say!(
            "  the same, processor time of all threads  mean {processor_ms:8.1} ms   fastest {:5.1} ms of wall time",
            percentile(&mut warm, 0.0)
        );
    }
    say!("  replans along a drive, new ground      p50 {steady_p50:9.1} ms");
    say!("  first query on an unseen map               {:9.1} ms", steady[0]);
    say!("  tokens per second, warm                    {:9.0}", (args.samples * args.horizon) as f64 / (p50 * 1e-3));
    if let (Some(hit), Some(error)) = (hit_rate, max_error) {
        say!(
            "  terrain cache: {:.1} % hits when warm; interpolation moves predictions by at most {:.2} % of the model's own error",
            100.0 * hit,
            100.0 * error
        );
    }
    if let Some(rounding) = rounding {
        say!("  rounding to bf16 moves predictions by at most {:.2} % of the model's own error", 100.0 * rounding);
    }
    if let Some(file) = &args.html {
        write_file(file, page::predict_page(&figures, &made_from).as_bytes())?;
    }
    match &args.json {
        Some(file) => write_json(file, &figures),
        None => Ok(()),
    }
}

/// Recorded drives from whose samples queries start.
pub(super) struct Planner<'a> {
    drives: Vec<Vec<HistoryStep>>,
    /// Drive and sample of each start.
    starts: Vec<(usize, usize)>,
    map: Option<Arc<WorldMap>>,
    range: [[f64; 2]; 2],
    args: &'a PredictBench,
}

impl<'a> Planner<'a> {
    /// The first drive whose history is full for some samples, or where none is so long every drive on the map of the first, with the history there is.
    fn new(drives: &Drives, args: &'a PredictBench) -> Result<Self, Failure> {
        let lengths: Vec<usize> = drives.drives.iter().map(|drive| drive.states.len()).collect();
        let long = lengths.iter().position(|samples| *samples >= HISTORY + STARTS_MIN);
        let map = drives.maps[long.unwrap_or(0)].clone();
        let on_map = |drive: usize| drives.maps[drive].as_ref().map(|map| map.hash()) == map.as_ref().map(|map| map.hash());
        let used = |drive: usize| long.map_or_else(|| on_map(drive), |long| drive == long);
        let used: Vec<usize> = (0..lengths.len()).filter(|drive| used(*drive)).collect();
        let starts = starts(&used.iter().map(|drive| lengths[*drive]).collect::<Vec<_>>());
        if starts.len() < STARTS_MIN {
            let samples: usize = used.iter().map(|drive| lengths[*drive]).sum();
            return Err(Failure::input(format!("the drives have {samples} samples, too few to start {STARTS_MIN} queries from")));
        }
        if long.is_none() {
            note!("note: no drive has {} samples: queries start with less than {HISTORY} steps of history", HISTORY + STARTS_MIN);
        }
        let steps = used.iter().map(|drive| history_steps(&drives.drives[*drive])).collect();
        Ok(Self { drives: steps, starts, map, range: drives.root.vehicle().command_range, args })
    }

    /// Start of the `q`-th replan; starts again at the beginning when the drives end.
    fn along(&self, q: usize) -> usize {
        q % (self.starts.len() - 1)
    }

    /// The `q`-th of `count` starts spread over the drives; its successor exists too.
    pub(super) fn anywhere(&self, q: usize, count: usize) -> usize {
        q * (self.starts.len() - 2) / count
    }

    /// The steps before a start, and the start.
    fn at(&self, start: usize) -> (&[HistoryStep], &HistoryStep) {
        let (drive, sample) = self.starts[start];
        (&self.drives[drive][..sample], &self.drives[drive][sample])
    }

    /// Commands of all candidates: the recorded command with correlated noise, inside the card's range; (samples, horizon, 2).
    pub(super) fn controls(&self, at: usize, seed: u64) -> Vec<f32> {
        self.controls_of(self.args.samples, at, seed)
    }

    /// The same for another number of candidates.
    pub(super) fn controls_of(&self, samples: usize, at: usize, seed: u64) -> Vec<f32> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let Control { speed_m_s, second } = self.at(at).1.control;
        let sd = [NOISE_SD[0], NOISE_SD[1] * (self.range[1][1] - self.range[1][0]) as f32 * 0.5];
        let mut controls = Vec::with_capacity(2 * samples * self.args.horizon);
        for _ in 0..samples {
            let mut noise = [0f32; 2];
            for _ in 0..self.args.horizon {
                for (c, nominal) in [speed_m_s, second].into_iter().enumerate() {
                    // Uniform of the same variance as a normal deviate.
                    let fresh = (rng.random::<f32>() - 0.5) * 12f32.sqrt() * sd[c];
                    noise[c] = NOISE_MEMORY * noise[c] + (1.0 - NOISE_MEMORY * NOISE_MEMORY).sqrt() * fresh;
                    controls.push((nominal as f32 + noise[c]).clamp(self.range[c][0] as f32, self.range[c][1] as f32));
                }
            }
        }
        controls
    }

    pub(super) fn ask(&self, predictor: &Predictor, at: usize, controls: &[f32]) -> Result<Rollout, Failure> {
        predictor.rollout(&self.query(at, controls)).or_failed()
    }

    /// A query of as many candidates as there are commands.
    pub(super) fn query<'q>(&'q self, at: usize, controls: &'q [f32]) -> RolloutQuery<'q> {
        let (history, start) = self.at(at);
        RolloutQuery {
            history,
            start: start.state,
            controls,
            samples: controls.len() / self.args.horizon / 2,
            horizon: self.args.horizon,
            map: self.map.as_ref(),
            soil_correction: SoilCorrection::NONE,
            variant: Variant::Full,
            start_time_s: None,
            wheels: None,
        }
    }
}

/// Drives and samples from which queries of drives of so many samples start: all that have a full history, or where a drive is too short for one all that have any.
fn starts(lengths: &[usize]) -> Vec<(usize, usize)> {
    let of_drive = |(drive, samples): (usize, &usize)| {
        let first = if *samples >= HISTORY + STARTS_MIN { HISTORY } else { 1 };
        (first..*samples).map(move |sample| (drive, sample))
    };
    lengths.iter().enumerate().flat_map(of_drive).collect()
}

/// Largest ratio over the six dimensions of how far the predictions of two predictors lie apart to what the second is off by, both as means over
/// windows and steps; `None` without a map or when no drive is long enough.
fn share_of_error(drives: &Drives, predictors: [&Predictor; 2], horizon: usize) -> Result<Option<f64>, Failure> {
    let mut windows = all_windows(&drives.drives, horizon, HISTORY, Truth::Measured).unwrap_or_default();
    windows.retain(|window| drives.maps[window.drive].is_some());
    if windows.is_empty() {
        return Ok(None);
    }
    // Horizontal position in the place of x and y, which depend on the heading.
    let apart = |a: &Pose, b: &Pose| {
        let [_, _, z, roll, pitch, yaw] = absolute_error(a, b);
        [horizontal_distance(a, b), z, roll, pitch, yaw]
    };
    let (mut moved, mut off) = ([0.0; 5], [0.0; 5]);
    for window in windows.iter().step_by(windows.len().div_ceil(CHECKED_WINDOWS)) {
        let map = drives.maps[window.drive].as_ref();
        let [first, second] = predictors.map(|p| roll_out(p, Variant::Full, SoilCorrection::NONE, window, None, map));
        for ((a, b), truth) in first.or_failed()?.poses.iter().zip(&second.or_failed()?.poses).zip(&window.truth(Truth::Measured)) {
            let (between, by_model) = (apart(a, b), apart(b, truth));
            for d in 0..moved.len() {
                moved[d] += between[d];
                off[d] += by_model[d];
            }
        }
    }
    Ok(moved.iter().zip(off).map(|(moved, off)| moved / off).reduce(f64::max))
}

/// Processor time of this process in user mode, all threads, ms; steadier than wall time on a machine that does other things. `None` where the system does
/// not say.
fn processor_time_ms() -> Option<f64> {
    const TICK_MS: f64 = 10.0;
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    // Fields after the name in parentheses; user time is the fourteenth of all.
    text.rsplit_once(')')?.1.split_whitespace().nth(11)?.parse::<f64>().ok().map(|ticks| ticks * TICK_MS)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: short drives are asked about one after the other, and a long one as ever. Method: starts of one long drive, of drives of 20, 1 and 3 samples.
    #[test]
    fn regress_queries_start_from_the_history_there_is() {
        let long = starts(&[HISTORY + STARTS_MIN]);
        assert_eq!((long.len(), long[0], long[7]), (8, (0, 32), (0, 39)));
        let short = starts(&[20, 1, 3]);
        assert_eq!((short.len(), short[0], short[18]), (21, (0, 1), (0, 19)));
        assert_eq!(short[19..], [(2, 1), (2, 2)]);
    }
}
