//! Goal: what the filter has beyond Algorithm 1 does what its settings say.
//! Method: twin drives by the same physics, each with one thing changed.
#![allow(clippy::unwrap_used)]

mod common;

use common::{LOAM, NOISE, SOFT, config, model, run, twin, white};
use nalgebra::DMatrix;
use nesam_adaptation::{BufferedTransition, FilterConfig, Innovation, NoiseConditions, SharedError, SoilFilter, SoilUpdate, conditions};
use nesam_physics::{SOIL_DIM, SoilCoordinates};

fn plain() -> FilterConfig {
    config(SoilCoordinates::Logarithmic)
}

/// A buffer of two means of five steps, as shipped settings have it.
fn of_means() -> FilterConfig {
    FilterConfig { innovation: Innovation::Rollout, block: 5, ..plain() }
}

#[test]
fn property_nothing_is_learned_where_the_ground_is_not_excited() {
    // Sensors a thousand times worse than the soil could move anything: the information of a buffer is nil, although Q_B would widen P.
    let deaf = FilterConfig { noise: white(1e3, 1e3).into(), process_sd: [0.05; 6], excitation_min: 1e-3, ..plain() };
    let (filter, updates) = run(deaf.clone(), &model(), &twin(&model(), SOFT, LOAM, 50, 1));
    assert!(updates.iter().all(|u| !u.excited && !u.rejected && u.excitation < 1e-3), "{updates:?}");
    assert_eq!(filter.posterior(), SoilFilter::new(deaf).unwrap().posterior());
    let (_, heard) = run(plain(), &model(), &twin(&model(), SOFT, LOAM, 50, 1));
    assert!(heard.iter().all(|u| u.excited && u.excitation > 1.0));
}

#[test]
fn property_a_class_that_was_never_driven_follows_as_far_as_it_shares() {
    let model = model();
    let on_class = |class: usize| -> Vec<BufferedTransition> {
        twin(&model, SOFT, LOAM, 200, 3).into_iter().map(|t| BufferedTransition { ground_class: class, ..t }).collect()
    };
    let of = |class_share: f64| {
        let (filter, _) = run(FilterConfig { classes: 3, class_share, ..plain() }, &model, &on_class(1));
        [0, 1, 2].map(|class| filter.posterior_of(class))
    };
    let [_, driven, other] = of(0.0);
    assert!(
        (0..SOIL_DIM).all(|i| (driven.correction.delta[i] - other.correction.delta[i]).abs() < 1e-9),
        "one for all: {driven:?} {other:?}"
    );
    let [_, driven, other] = of(1.0);
    assert_eq!(other.correction.delta, [0.0; SOIL_DIM], "nothing in common");
    assert!(driven.learned.iter().any(|l| *l) && other.learned.iter().all(|l| !l));
    let [unknown, driven, other] = of(0.4);
    // Linear in the covariances: what is common passes on the share 1 - 0.4.
    for i in 0..SOIL_DIM {
        assert!((other.correction.delta[i] - 0.6 * driven.correction.delta[i]).abs() < 1e-6, "{i}: {driven:?} {other:?}");
    }
    let same = (0..SOIL_DIM).all(|i| (unknown.correction.delta[i] - other.correction.delta[i]).abs() < 1e-9);
    assert!(same, "ground that tells no class is one more: {unknown:?} {other:?}");
}

#[test]
fn property_ground_that_changes_unannounced_is_learned_anew() {
    let model = model();
    let distance = |filter: &SoilFilter, soil: [f64; SOIL_DIM]| {
        let (truth, posterior) = (SoilCoordinates::Logarithmic.between(&LOAM, &soil), filter.posterior());
        // k_phi, φ and K: what this drive can tell. n and c act through sums with them.
        [0, 4, 5].map(|i| ((posterior.correction.delta[i] - truth[i]) / plain().prior_sd[i]).powi(2)).iter().sum::<f64>().sqrt()
    };
    let (mut settled, mut open) = (0.0, 0.0);
    for seed in 0..4 {
        // Half a drive on soft ground, half on ground that is what it looks like.
        let (soft, usual) = (twin(&model, SOFT, LOAM, 150, seed), twin(&model, LOAM, LOAM, 150, seed + 10));
        let whole: Vec<BufferedTransition> = soft.iter().chain(&usual).copied().collect();
        let expects_change = FilterConfig { change_probability: 0.03, ..plain() };
        settled += distance(&run(plain(), &model, &whole).0, LOAM);
        let mut filter = SoilFilter::new(expects_change.clone()).unwrap();
        for transition in &whole {
            let update = filter.push(&model, *transition).unwrap();
            let covariance = filter.covariance();
            let told = |update: &SoilUpdate| (0..SOIL_DIM).all(|i| covariance[(i, i)] <= update.before.covariance[i][i] * (1.0 + 1e-9));
            assert!(update.as_ref().is_none_or(told), "what a buffer tells is more than what was believed when it was met");
            assert!(
                (0..SOIL_DIM).all(|i| covariance[(i, i)] <= expects_change.prior_sd[i].powi(2) * (1.0 + 1e-12)),
                "never less sure than P₀"
            );
        }
        open += distance(&filter, LOAM);
        // Ground that stays: the same is learned.
        let [with, without] = [expects_change, plain()].map(|config| distance(&run(config, &model, &soft).0, SOFT));
        assert!(with < without + 0.1, "{with} and {without}");
    }
    println!(
        "standard deviations of the prior that the estimate is off 15 s after a change: {} without, {} with",
        settled / 4.0,
        open / 4.0
    );
    assert!(open < 0.5 * settled, "{open} and {settled}");
}

#[test]
fn property_two_classes_in_one_buffer_are_told_apart() {
    // Five steps on each; derivatives with respect to one class are those of its own steps. Sum over classes = derivative with respect to a common correction.
    let model = model();
    let mut transitions = twin(&model, SOFT, LOAM, 10, 2);
    let common = run(FilterConfig { linearisations: 1, ..of_means() }, &model, &transitions).1.pop().unwrap();
    for (k, t) in transitions.iter_mut().enumerate() {
        t.ground_class = k / 5;
    }
    let one = FilterConfig { linearisations: 1, classes: 2, class_share: 0.0, ..of_means() };
    let split = run(one, &model, &transitions).1.pop().unwrap();
    assert!((split.nis - common.nis).abs() < 1e-6 * common.nis, "{} {}", split.nis, common.nis);
    assert!((0..SOIL_DIM).all(|i| (split.posterior.correction.delta[i] - common.posterior.correction.delta[i]).abs() < 1e-6));
}

#[test]
fn property_an_error_that_carries_on_is_foreseen() {
    // The right soil and a speed that always reads 0.1 m/s too high: one standard deviation of what R_B allows. A filter that follows it expects the next buffer to err
    // alike; one that takes buffers for independent is surprised by the same error every time.
    let model = model();
    let mut transitions = twin(&model, LOAM, LOAM, 300, 4);
    for t in &mut transitions {
        t.measured_next[0] += 0.1;
    }
    let mut shared = DMatrix::zeros(12, 12);
    for r in [0, 6] {
        for c in [0, 6] {
            shared[(r, c)] = 0.01;
        }
    }
    let mut noise = white(NOISE[0], NOISE[1]).covariance(2);
    noise += &shared;
    let told = FilterConfig { noise: nesam_adaptation::BufferNoise::Sampled(noise), ..of_means() };
    let following = FilterConfig { shared_error: Some(SharedError { covariance: shared, correlation: 0.99 }), ..told.clone() };
    let late = |config: &FilterConfig| -> f64 {
        let updates = run(config.clone(), &model, &transitions).1;
        updates[10..].iter().map(|u| u.log_likelihood).sum::<f64>() / (updates.len() - 10) as f64
    };
    let (without, with) = (late(&told), late(&following));
    println!("log likelihood of a buffer: {without:.2} without, {with:.2} with the shared error");
    assert!(with > without + 1.0, "{without} {with}");
}

#[test]
fn property_a_wild_buffer_teaches_less_with_heavy_tails() {
    let model = model();
    let mut transitions = twin(&model, LOAM, LOAM, 10, 5);
    for t in &mut transitions {
        t.measured_next[0] += 0.3;
    }
    let moved = |tail_dof: f64| {
        let (filter, _) = run(FilterConfig { tail_dof, linearisations: 1, ..plain() }, &model, &transitions);
        let delta = filter.posterior().correction.delta;
        (0..SOIL_DIM).map(|i| (delta[i] / plain().prior_sd[i]).powi(2)).sum::<f64>()
    };
    assert!(moved(4.0) < 0.9 * moved(0.0), "{} {}", moved(4.0), moved(0.0));
}

#[test]
fn property_caution_with_a_channel_is_for_what_is_learned_and_not_for_the_nis() {
    let model = model();
    let moved = |caution: [f64; 6], channel: usize| {
        let mut transitions = twin(&model, LOAM, LOAM, 10, 5);
        transitions.iter_mut().for_each(|t| t.measured_next[channel] += 0.1);
        let (filter, updates) = run(FilterConfig { caution, linearisations: 1, ..plain() }, &model, &transitions);
        let delta = filter.posterior().correction.delta;
        ((0..SOIL_DIM).map(|i| (delta[i] / plain().prior_sd[i]).powi(2)).sum::<f64>(), updates[0].nis)
    };
    let of_heave = [1.0, 1.0, 10.0, 1.0, 1.0, 1.0];
    let ((heave, nis), (cautious, same_nis)) = (moved([1.0; 6], 2), moved(of_heave, 2));
    assert!(cautious < 0.1 * heave && nis == same_nis, "{heave} {cautious}, {nis} {same_nis}");
    let (speed, still) = (moved([1.0; 6], 0).0, moved(of_heave, 0).0);
    assert!(still > 0.5 * speed, "what speed tells is still learned: {speed} {still}");
}

#[test]
fn analytic_the_factor_on_the_noise_is_log_linear_and_limited() {
    let transitions = twin(&model(), LOAM, LOAM, 10, 6);
    let here = conditions(&transitions);
    assert!(here.iter().all(|v| v.is_finite()) && here[0] > 0.5 && (here[3] - LOAM[0].ln()).abs() < 1e-9, "{here:?}");
    let of = |slope: f64| NoiseConditions { mean: [0.0; 4], slope: [slope, 0.0, 0.0, 0.0] }.factor(&[0.5, 9.0, 9.0, 9.0]);
    assert!((of(1.0) - 0.5_f64.exp()).abs() < 1e-12 && of(100.0) == 10.0 && of(-100.0) == 0.1);
}
