//! More of `nesam bench predict`: every path and number of candidates, the reference on other devices, and where the time goes.

use std::sync::Arc;
use std::time::Instant;

use nesam_model::reference::{ComputeDevice, ReferencePredictor};
use nesam_model::{Path, Precision, Predictor};
use nesam_physics::STATE_DIM;
use serde_json::{Value, json};

use super::percentile;
use super::predict::Planner;
use crate::failure::{Failure, OrFail};
use crate::output::say;

/// Numbers of candidates that a sweep times.
const CANDIDATES: [usize; 6] = [64, 128, 256, 512, 1024, 2048];
/// Timed queries of each; their terrain is warm.
const QUERIES: usize = 7;

/// The predictor on every path of this processor, f32 first.
fn on_all_paths(predictor: &Predictor) -> Vec<Predictor> {
    let in_f32 = Path::available().into_iter().map(|path| predictor.in_precision(Precision::F32).on_path(path));
    let in_bf16 = Path::for_bf16().into_iter().map(|(order, _)| predictor.in_precision(Precision::Bf16(order)));
    in_f32.chain(in_bf16).collect()
}

/// The predictor on the path of this name, or as it is.
pub fn on_path(predictor: Arc<Predictor>, name: Option<&str>) -> Result<Arc<Predictor>, Failure> {
    let Some(name) = name else { return Ok(predictor) };
    let all = on_all_paths(&predictor);
    let known: Vec<&str> = all.iter().map(|predictor| predictor.path().as_str()).collect();
    let unknown = Failure::input(format!("--path {name}: this processor has {}", known.join(", ")));
    all.into_iter().find(|predictor| predictor.path().as_str() == name).map(Arc::new).ok_or(unknown)
}

/// Times all numbers of candidates on all paths and prints a table. The paths take turns, so that what else the machine does meets all of them.
pub fn sweep(drive: &Planner<'_>, predictor: &Predictor) -> Result<Value, Failure> {
    let predictors = on_all_paths(predictor);
    let header: Vec<String> = predictors.iter().map(|p| format!("{:>11} p50      min", p.path().as_str())).collect();
    say!("  warm, by candidates and path, ms\n       N {}", header.join(" "));
    let mut rows = Vec::new();
    for samples in CANDIDATES {
        let mut times = vec![Vec::new(); predictors.len()];
        for q in 0..=QUERIES {
            let at = drive.anywhere(1, 3);
            let controls = drive.controls_of(samples, at, 3000 + q as u64);
            for (predictor, times) in predictors.iter().zip(&mut times) {
                // The first time encodes what is missing.
                drive.ask(predictor, at, &controls)?;
                let began = Instant::now();
                drive.ask(predictor, at, &controls)?;
                if q > 0 {
                    times.push(began.elapsed().as_secs_f64() * 1e3);
                }
            }
        }
        let mut line = format!("    {samples:4} ");
        for (predictor, times) in predictors.iter().zip(&mut times) {
            let (p50, min) = (percentile(times, 0.5), percentile(times, 0.0));
            line += &format!("{p50:15.1} {min:8.1} ");
            rows.push(json!({"path": predictor.path().as_str(), "samples": samples, "p50_ms": p50, "min_ms": min}));
        }
        say!("{}", line.trim_end());
    }
    Ok(Value::Array(rows))
}

/// Times the reference on devices in turns with the predictor, terrain warm, and says how far apart they predict.
pub fn reference(drive: &Planner<'_>, predictor: &Predictor, devices: &[ComputeDevice]) -> Result<Value, Failure> {
    if devices.is_empty() {
        return Ok(Value::Null);
    }
    let open = |device: &ComputeDevice| Ok((*device, ReferencePredictor::new(predictor, *device).or_input()?, Vec::new(), 0f32));
    let mut on: Vec<_> = devices.iter().map(open).collect::<Result<_, Failure>>()?;
    let mut own = Vec::new();
    for q in 0..=QUERIES {
        let at = drive.anywhere(q, QUERIES + 1);
        let controls = drive.controls(at, 5000 + q as u64);
        // The first time encodes what is missing.
        drive.ask(predictor, at, &controls)?;
        let began = Instant::now();
        let answer = drive.ask(predictor, at, &controls)?;
        own.push(began.elapsed().as_secs_f64() * 1e3);
        for (_, reference, times, apart_m) in &mut on {
            let began = Instant::now();
            let states = reference.rollout(&drive.query(at, &controls)).or_failed()?;
            times.push(began.elapsed().as_secs_f64() * 1e3);
            let pairs = states.chunks_exact(STATE_DIM).zip(answer.states.chunks_exact(STATE_DIM));
            *apart_m = pairs.map(|(a, b)| f32::hypot(a[0] - b[0], a[1] - b[1])).fold(*apart_m, f32::max);
        }
    }
    let mut rows = Vec::new();
    for (device, _, times, apart_m) in &mut on {
        // The first query of a device also loads its kernels.
        let [p50, own_p50] = [&mut times[1..], &mut own[1..]].map(|times| percentile(times, 0.5));
        say!(
            "  reference on {device}: p50 {p50:.1} ms, the predictor in turns with it {own_p50:.1} ms; at most {:.2} mm apart",
            1e3 * *apart_m
        );
        rows.push(json!({"device": device.to_string(), "p50_ms": p50, "predictor_p50_ms": own_p50, "apart_max_m": *apart_m}));
    }
    Ok(Value::Array(rows))
}

/// Processor time of a warm query by parts, medians over queries, ms of all threads together.
pub fn parts(drive: &Planner<'_>, predictor: &Predictor) -> Result<Value, Failure> {
    let mut times: [Vec<f64>; 4] = Default::default();
    for q in 0..QUERIES {
        let at = drive.anywhere(q, QUERIES);
        let controls = drive.controls(at, 4000 + q as u64);
        drive.ask(predictor, at, &controls)?;
        let (_, parts) = predictor.rollout_by_parts(&drive.query(at, &controls)).or_failed()?;
        for (times, part) in times.iter_mut().zip([parts.lookup_s, parts.network_s, parts.physics_s, parts.rest_s]) {
            times.push(part * 1e3);
        }
    }
    let [lookup, network, physics, rest] = times.map(|mut times| percentile(&mut times, 0.5));
    say!(
        "  by parts, ms of all threads: lookup {lookup:.1}, network {network:.1}, physics {physics:.1}, ground, actuators and states {rest:.1}"
    );
    Ok(json!({"lookup": lookup, "network": network, "physics": physics, "rest": rest}))
}
