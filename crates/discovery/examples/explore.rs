//! Scratch.
#![allow(clippy::unwrap_used)]
use nesam_discovery::report::{Report, describe};
use nesam_discovery::*;
use nesam_model::{ModelBundle, Predictor};
use nesam_trajectories::{DataRoot, SetQuery, SplitFilter};
use std::sync::Arc;
use std::time::Instant;

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let root = DataRoot::open(std::path::Path::new("../shared/data/chrono"), None).unwrap();
    let mut bundle = ModelBundle::load(std::path::Path::new(&args[2])).unwrap();
    let refpath = format!("/tmp/disc-ref-{}.json", &bundle.hash[..8]);
    let load = |set: &str, split, ids: Option<Vec<String>>| {
        let drives = root.load_set(&SetQuery { set: set.into(), split, trajectories: ids, dt_s: 0.1, ground_truth: false }).unwrap();
        let maps: Vec<_> = drives.iter().map(|d| d.world.as_deref().map(|w| root.world(w).unwrap())).collect();
        (drives, maps)
    };
    let t = Instant::now();
    if args[1] == "ref" {
        let (mut drives, _) = load("nominal", SplitFilter::Train, None);
        drives.sort_by(|a, b| a.id.cmp(&b.id));
        let drives: Vec<_> = drives.into_iter().enumerate().filter(|(i, _)| i % 10 == 7).map(|(_, d)| d).collect();
        let maps: Vec<_> = drives.iter().map(|d| d.world.as_deref().map(|w| root.world(w).unwrap())).collect();
        let predictor = Predictor::new(Arc::new(bundle.clone())).unwrap();
        let observed = observe_all(&predictor, &drives, &maps, &|d| eprintln!("{d} {:.0}s", t.elapsed().as_secs_f64())).unwrap();
        let stepping = Stepping { dt_s: 0.1, substeps: bundle.normalization.substeps };
        let reference = Reference::measure(&bundle.vehicle, stepping, &observed, "x").unwrap();
        eprintln!("measured {:.0}s", t.elapsed().as_secs_f64());
        std::fs::write(&refpath, reference.to_json()).unwrap();
        for c in &reference.channels {
            println!(
                "{:24} mean {:?} scale {:?} colour {:.2} offset {:.2}",
                c.name,
                c.mean.map(|v| (v * 1e4).round() / 1e4),
                c.scale.map(|v| (v * 1e4).round() / 1e4),
                c.colour,
                c.offset_sd
            );
        }
        for n in [4, 5] {
            let g = reference.null_groups(n).unwrap();
            println!("n {n}: spread {:?} threshold {:.2}", g.spread, g.threshold);
        }
        return;
    }
    bundle.reference_json = Some(std::fs::read_to_string(&refpath).unwrap());
    let predictor = Predictor::new(Arc::new(bundle)).unwrap();
    if args[1] == "truth" {
        use nesam_discovery::refit::*;
        use nesam_discovery::scan::*;
        use nesam_discovery::whitening::*;
        use nesam_physics::SoilCorrection;
        let reference = Reference::from_json(predictor.bundle().reference_json.as_ref().unwrap()).unwrap();
        let (drives, maps) = load(&args[3], SplitFilter::All, None);
        let observed = observe_all(&predictor, &drives, &maps, &|_| {}).unwrap();
        let w = Whitening::new(&reference, &[true; 29]).unwrap();
        let st = Stepping { dt_s: 0.1, substeps: 2 };
        let v = &predictor.bundle().vehicle;
        let prepared: Vec<_> = observed.iter().map(|d| prepare(&w, v, st, d)).collect();
        let members: Vec<_> = observed.iter().zip(&prepared).collect();
        let bench = Bench { whitening: &w, vehicle: v, stepping: st };
        let cand = if args[3].contains("payload") { Candidate::Payload } else { Candidate::WheelDrag(3) };
        let mut tries: Vec<Vec<f64>> = args[4..].iter().map(|a| a.split(',').map(|x| x.parse().unwrap()).collect()).collect();
        let fit = fit_effect(&bench, &members, cand, tries[0].clone());
        println!("fit from first: {:?} sd {:?} pen {:.1}", fit.values, fit.sd, fit.penalised);
        tries.push(fit.values.clone());
        for t in tries {
            println!("{t:?} misfit {:.1}", misfit_at(&bench, &members, cand, &t));
            let model = st.model(&v.with_effects(&[cand.effect(&t)]));
            let mut line = String::new();
            for c in 0..29 {
                let (mut sum, mut n) = (0.0, 0.0);
                for d in &observed {
                    for (s, row) in d.deviations(&model, &SoilCorrection::NONE).iter().enumerate() {
                        sum += reference.scaled(c, d, s, row);
                        n += 1.0;
                    }
                }
                line += &format!("{}:{:+.2} ", channels::name(c), sum / n);
            }
            println!("   {line}");
        }
        return;
    }
    for spec in &args[3..] {
        let t = Instant::now();
        let (set, ids) = match spec.split_once(':') {
            Some((s, i)) => (s, Some(i.split(',').map(String::from).collect())),
            None => (spec.as_str(), None),
        };
        let split = if set == "nominal" { SplitFilter::Test } else { SplitFilter::All };
        let (drives, maps) = load(set, split, ids);
        let options = Options { fit_on: None, without: vec![], scoring: Scoring { horizon: 32, history: 32, resamples: 1000, seed: 1 } };
        let found = diagnose(&predictor, &drives, &maps, &options, &|_, _, _| {}).unwrap();
        let report = Report { set, diagnosis: &found, bundle: None, provenance: &Default::default(), dt_s: 0.1 };
        println!(
            "== {spec}: {:?} {} ({:.0}s) threshold {:.2} p {:?} dispersion {:.2}/{:.2}",
            found.verdict,
            found.reason,
            t.elapsed().as_secs_f64(),
            found.selection.threshold,
            found.selection.probability,
            found.selection.strength.dispersion,
            found.selection.dispersion
        );
        for (e, c) in Candidate::ALL.iter().enumerate() {
            let r = found.selection.ranked.iter().find(|r| r.fit.candidate == *c);
            println!(
                "  {:18} z {:7.2} raw {:7.2} {}",
                c.label(),
                found.selection.z[e].unwrap_or(-1.0),
                found.selection.strength.z[e],
                r.map_or(String::new(), |r| format!(
                    "bic {:+.1} w {:.3} {} sd {:?} {:?}",
                    r.bic,
                    r.weight,
                    describe(r),
                    r.fit.sd,
                    r.refused
                ))
            );
        }
        for e in &found.estimates {
            println!("  {} {:.4} {:?}", e.name, e.value, e.ci95);
        }
        for l in &found.learned {
            println!("  fold {:?} soil {:?}", l.effects, l.soil.delta.map(|v| (v * 100.0).round() / 100.0));
        }
        println!("  stability {:?}", found.stability);
        let mut ch: Vec<_> = found.channels.iter().collect();
        ch.sort_by(|a, b| b.significance.abs().total_cmp(&a.significance.abs()));
        for c in ch.iter().take(8) {
            println!("  {:24} mean {:+.2} sig {:+.1}", channels::name(c.channel), c.mean, c.significance);
        }
        for (name, t) in report.stages() {
            println!(
                "  {name:10} {:?} pos {:.3} final {:.3}",
                t.mae_mean.to_array().map(|v| (v.unwrap() * 1e3).round() / 1e3),
                t.position_m.mean.unwrap(),
                t.position_m.final_.unwrap()
            );
        }
    }
}
