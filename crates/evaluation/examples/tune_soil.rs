//! scratch
use nesam_adaptation::*;
use nesam_evaluation::*;
use nesam_model::*;
use nesam_physics::*;
use nesam_trajectories::*;
use rayon::prelude::*;
use std::io::BufRead;
use std::path::Path;
use std::sync::Arc;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let (bundle, set, split) = (&a[1], &a[2], &a[3]);
    let ids: Option<Vec<String>> = (a[4] != "-").then(|| a[4].split(',').map(String::from).collect());
    let predictor = Arc::new(Predictor::new(Arc::new(ModelBundle::load(Path::new(bundle)).unwrap())).unwrap());
    let model = predictor.step_model();
    let root = DataRoot::open(Path::new("../shared/data/chrono"), None).unwrap();
    let split = match split.as_str() {
        "train" => SplitFilter::Train,
        "test" => SplitFilter::Test,
        _ => SplitFilter::All,
    };
    let drives = root.load_set(&SetQuery { set: set.clone(), split, trajectories: ids, dt_s: 0.1, ground_truth: false }).unwrap();
    let maps: Vec<_> = drives.iter().map(|d| d.world.as_deref().map(|w| root.world(w).unwrap())).collect();
    let windows = all_windows(&drives, 32, 32, Truth::Measured).unwrap();
    let t = std::time::Instant::now();
    let trans: Vec<Vec<BufferedTransition>> = drives
        .par_iter()
        .zip(&maps)
        .map(|(d, m)| {
            let steps: Vec<HistoryStep> =
                d.states.iter().zip(&d.controls).map(|(&state, &control)| HistoryStep { state, control }).collect();
            (0..steps.len() - 1)
                .map(|k| {
                    let h = &steps[k.saturating_sub(HISTORY - 1)..k];
                    let tr = predictor.transition(h, &steps[k].state, &steps[k].control, m.as_ref());
                    let x = steps[k + 1].state.to_array();
                    BufferedTransition { input: tr.input, residual: tr.residual, measured_next: std::array::from_fn(|c| x[6 + c]) }
                })
                .collect()
        })
        .collect();
    let n: usize = trans.iter().map(Vec::len).sum();
    println!("windows {} transitions {n} in {:?}", windows.len(), t.elapsed());
    let res = Resamples::draw(drives.len(), 1000, 1);
    let eval = |n: &str, offset: [f64; 6], f: &[Vec<TimedUpdate>]| {
        let filtered: Vec<DriveAdaptation> = f
            .iter()
            .map(|u| {
                let mut u = u.clone();
                u.insert(
                    0,
                    TimedUpdate {
                        sample: 0,
                        prior: [1.0; 6],
                        update: SoilUpdate {
                            posterior: SoilPosterior { correction: SoilCorrection::NONE, covariance: [[0.0; 6]; 6], learned: [false; 6] },
                            innovation: vec![],
                            nis: 0.0,
                            dof: 60,
                            rejected: true,
                        },
                    },
                );
                for x in &mut u {
                    for i in 0..6 {
                        x.update.posterior.correction.delta[i] += offset[i];
                    }
                }
                DriveAdaptation { updates: u, ..Default::default() }
            })
            .collect();
        let p = predict_all(
            &[(ModelName::Nesam, WindowPredictor::Adapted { predictor: predictor.clone(), filtered: Arc::new(filtered) })],
            &windows,
            &maps,
            &|_| (),
        )
        .unwrap();
        let s = score(&p[0], &windows, Truth::Measured, &res);
        let m = s.summary.tree.mae_mean.to_array();
        let p = s.summary.tree.position_m;
        println!(
            "{n:<60} zrpy {:.4?} pos {:.4} final {:.4} yawF {:.3}",
            &m[2..].iter().map(|v| v.unwrap()).collect::<Vec<_>>(),
            p.mean.unwrap(),
            p.final_.unwrap(),
            s.summary.tree.mae_final.yaw_deg.unwrap()
        );
    };
    let none: Vec<Vec<TimedUpdate>> = vec![vec![]; drives.len()];
    let runs: Vec<Vec<[f64; 6]>> = trans.iter().map(|t| t.iter().map(|t| t.innovation(model, &SoilCorrection::NONE)).collect()).collect();
    let noise = VelocityNoise::estimate(&runs).unwrap();
    println!("noise {:?}", noise.channels);
    for lag in [0usize, 1, 2, 5, 10, 15, 20, 30, 50] {
        let c: Vec<f64> = (0..6)
            .map(|c| {
                let (mut s, mut m) = (0.0, 0.0);
                for r in &runs {
                    for k in lag..r.len() {
                        s += r[k][c] * r[k - lag][c];
                        m += 1.0;
                    }
                }
                s / m
            })
            .collect();
        println!("lag {lag} {:?}", c.iter().map(|v| v.abs().sqrt() * v.signum()).map(|v| (v * 1e4).round() / 1e4).collect::<Vec<_>>());
    }
    // commands from stdin: name|offset(6 numbers or 0)|json (noise: "est")
    for line in std::io::stdin().lock().lines() {
        let line = line.unwrap();
        let parts: Vec<&str> = line.split('|').collect();
        if parts.len() < 3 {
            continue;
        }
        let offset: [f64; 6] = {
            let v: Vec<f64> = parts[1].split(',').map(|x| x.trim().parse().unwrap()).collect();
            if v.len() == 6 { std::array::from_fn(|i| v[i]) } else { [0.0; 6] }
        };
        if parts[2] == "fixed" {
            eval(parts[0], offset, &none);
            continue;
        }
        let literal = parts[2].starts_with("lit");
        let js = parts[2].trim_start_matches("lit");
        let set = FilterSettings::from_json(js).unwrap();
        let mut cfg = set.over_defaults(literal);
        if set.noise.is_none() {
            cfg.noise = noise;
        }
        let shift = SoilCorrection { coordinates: SoilCoordinates::Logarithmic, delta: offset };
        let out: Vec<Vec<TimedUpdate>> = trans
            .par_iter()
            .map(|t| {
                let mut f = SoilFilter::new(cfg).unwrap();
                let mut u = vec![];
                for (k, x) in t.iter().enumerate() {
                    let mut x = *x;
                    let prior = shift.apply(&x.input.soil.to_array());
                    x.input.soil = Soil::from_array(prior);
                    if let Ok(Some(update)) = f.push(model, x) {
                        u.push(TimedUpdate { sample: k + 1, prior, update });
                    }
                }
                u
            })
            .collect();
        let all: Vec<&TimedUpdate> = out.iter().flatten().collect();
        let nis = all.iter().map(|u| u.update.nis / 60.0).sum::<f64>() / all.len() as f64;
        let late: Vec<&TimedUpdate> = out.iter().filter_map(|u| u.last()).collect();
        let rms: Vec<f64> = (0..6)
            .map(|i| {
                (late.iter().map(|u| (u.update.posterior.correction.delta[i] + offset[i]).powi(2)).sum::<f64>() / late.len() as f64).sqrt()
            })
            .collect();
        let sd: Vec<f64> =
            (0..6).map(|i| (late.iter().map(|u| u.update.posterior.covariance[i][i]).sum::<f64>() / late.len() as f64).sqrt()).collect();
        let mean: Vec<f64> = (0..6)
            .map(|i| late.iter().map(|u| u.update.posterior.correction.delta[i] + offset[i]).sum::<f64>() / late.len() as f64)
            .collect();
        eval(parts[0], offset, &out);
        println!("      nis {nis:.2} rej {} mean {mean:.2?} rms {rms:.2?} sd {sd:.2?}", all.iter().filter(|u| u.update.rejected).count());
    }
}
