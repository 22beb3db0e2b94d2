//! Goal: the filter is Algorithm 1, finds the soil that it should find, is honest about how well, and is undisturbed by bad input.
//! Method: twin drives by the same physics on another soil with seeded sensor noise; closed forms; finite differences.
#![allow(clippy::unwrap_used)]

mod common;

use common::{LOAM, NOISE, SOFT, config, model, run, twin, white};
use nalgebra::{DMatrix, DVector};
use nesam_adaptation::{
    AdaptationError, BufferNoise, BufferedTransition, FilterConfig, Innovation, SharedError, SoilFilter, UncorrectedBuffer, VELOCITY_DIM,
    calibrate, chi_square_tail, predict_velocity,
};
use nesam_physics::{SOIL_BOUNDS, SOIL_DIM, Soil, SoilCoordinates, SoilCorrection};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

#[test]
fn analytic_jacobian_equals_finite_differences() {
    let model = model();
    for coordinates in [SoilCoordinates::Physical, SoilCoordinates::Logarithmic] {
        let correction = SoilCorrection { coordinates, delta: coordinates.between(&LOAM, &SOFT) };
        // k_c alone has the slope of the first estimate in place of its own.
        let first_slope = coordinates.first_slope_of_k_c(&Soil::from_array(LOAM), SOFT[0]);
        let of_first = [1.0, first_slope.map_or(1.0, |slope| slope / coordinates.slope(&SOFT)[1]), 1.0, 1.0, 1.0, 1.0];
        for transition in twin(&model, SOFT, LOAM, 20, 3) {
            let analytic = predict_velocity(&model, &transition, &correction).jacobian;
            for i in 0..SOIL_DIM {
                let step = 1e-5 * coordinates.slope(&SOFT)[i].recip() * SOFT[i];
                let at = |sign: f64| {
                    let mut moved = correction;
                    moved.delta[i] += sign * step;
                    predict_velocity(&model, &transition, &moved).velocity
                };
                let (up, down) = (at(1.0), at(-1.0));
                for c in 0..VELOCITY_DIM {
                    let difference = of_first[i] * (up[c] - down[c]) / (2.0 * step);
                    let scale = analytic.iter().map(|row| row[i].abs()).fold(1e-9 / step, f64::max);
                    assert!((difference - analytic[c][i]).abs() < 1e-4 * scale, "{coordinates:?} {c} {i}: {difference} {}", analytic[c][i]);
                }
            }
        }
    }
}

#[test]
fn analytic_clipped_parameters_have_no_derivative() {
    let model = model();
    let transition = twin(&model, LOAM, LOAM, 1, 1)[0];
    let mut correction = SoilCorrection::default();
    correction.delta[4] = 10.0;
    let predicted = predict_velocity(&model, &transition, &correction);
    assert!(predicted.jacobian.iter().all(|row| row[4] == 0.0) && predicted.jacobian.iter().any(|row| row[0] != 0.0));
    correction.delta[4] = SOIL_BOUNDS[4].1 - LOAM[4];
    let velocity = predict_velocity(&model, &transition, &correction).velocity;
    assert!((0..VELOCITY_DIM).all(|c| (velocity[c] - predicted.velocity[c]).abs() < 1e-12), "beyond the bound is the bound");
}

#[test]
fn analytic_zero_innovation_changes_nothing_but_the_certainty() {
    let model = model();
    let mut transitions = twin(&model, SOFT, LOAM, 10, 1);
    for t in &mut transitions {
        t.measured_next = predict_velocity(&model, t, &SoilCorrection::NONE).velocity;
    }
    let (filter, updates) = run(config(SoilCoordinates::Logarithmic), &model, &transitions);
    assert_eq!((updates.len(), updates[0].nis), (1, 0.0));
    assert_eq!(filter.posterior().correction, SoilCorrection::NONE);
    let prior = config(SoilCoordinates::Logarithmic).prior_sd;
    assert!((0..SOIL_DIM).all(|i| filter.posterior().covariance[i][i] <= prior[i] * prior[i]));
}

#[test]
fn property_twin_estimate_moves_towards_the_truth_and_is_consistent() {
    let model = model();
    for coordinates in [SoilCoordinates::Physical, SoilCoordinates::Logarithmic] {
        let (mut error, mut at_start, mut nis, mut buffers) = (0.0, 0.0, 0.0, 0);
        for seed in 0..6 {
            let transitions = twin(&model, SOFT, LOAM, 300, seed);
            let (filter, updates) = run(config(coordinates), &model, &transitions);
            let found = filter.posterior().correction;
            let innovation = |correction: &SoilCorrection| -> f64 {
                let of = |t: &BufferedTransition| predict_velocity(&model, t, correction).velocity;
                let truth = SoilCorrection { coordinates, delta: coordinates.between(&LOAM, &SOFT) };
                let distance = |t: &BufferedTransition| {
                    let (a, b) = (of(t), predict_velocity(&model, t, &truth).velocity);
                    (0..VELOCITY_DIM).map(|c| ((a[c] - b[c]) / NOISE[c / 3]).powi(2)).sum::<f64>()
                };
                (transitions.iter().map(distance).sum::<f64>() / transitions.len() as f64).sqrt()
            };
            error += innovation(&found) / 6.0;
            at_start += innovation(&SoilCorrection { coordinates, delta: [0.0; 6] }) / 6.0;
            // The first buffers still carry the linearisation of a large correction.
            nis += updates[5..].iter().map(|u| u.nis / u.dof as f64).sum::<f64>();
            buffers += updates.len() - 5;
        }
        let nis = nis / buffers as f64;
        println!("{coordinates:?}: prediction error {at_start:.3} -> {error:.3} noise widths, NIS/dof {nis:.3}");
        assert!(error < 0.2 * at_start, "{coordinates:?}: {error} of {at_start}");
        // One linearisation in physical units lands beside the truth and is certain of it: Algorithm 1 to the letter is not consistent here.
        let band = if coordinates == SoilCoordinates::Physical { 0.9..10.0 } else { 0.9..1.15 };
        assert!(band.contains(&nis), "{coordinates:?}: NIS over degrees of freedom {nis}");
    }
}

#[test]
fn property_twin_errors_are_as_large_as_the_filter_says() {
    let model = model();
    let coordinates = SoilCoordinates::Logarithmic;
    let truth = coordinates.between(&LOAM, &SOFT);
    let (mut inside, mut all) = (0, 0);
    for seed in 0..24 {
        let (filter, _) = run(config(coordinates), &model, &twin(&model, SOFT, LOAM, 200, seed));
        let posterior = filter.posterior();
        for i in (0..SOIL_DIM).filter(|i| posterior.learned[*i]) {
            inside += usize::from((posterior.correction.delta[i] - truth[i]).abs() < 2.5 * posterior.covariance[i][i].sqrt());
            all += 1;
        }
    }
    println!("{inside} of {all} learned parameters within 2.5 standard deviations");
    assert!(all > 24 && inside as f64 > 0.7 * all as f64, "{inside} of {all}");
}

#[test]
fn property_one_sum_of_moduli_is_not_two_learned_parameters() {
    // k_c acts as k_c / b + k_phi: with b = 0.254 m and a modulus of 1.5e6 it is 1.3 % of the sum and cannot be told from it, however many drives are seen and
    // wherever the estimate has moved meanwhile.
    let model = model();
    let config = config(SoilCoordinates::Logarithmic);
    for seed in 0..6 {
        let (filter, _) = run(config.clone(), &model, &twin(&model, SOFT, LOAM, 300, seed));
        let posterior = filter.posterior();
        let left = posterior.covariance[1][1] / config.prior_sd[1].powi(2);
        assert!(left > 0.99 && !posterior.learned[1], "k_c cannot be learned, drive {seed}: {left} of its variance is left");
        assert!(posterior.learned.iter().any(|l| *l), "something can: {:?}", posterior.learned);
    }
}

#[test]
fn property_a_rejected_buffer_leaves_the_estimate_untouched() {
    let model = model();
    let mut gated = config(SoilCoordinates::Logarithmic);
    gated.gate_tail_probability = 1e-9;
    gated.process_sd = [0.1; 6];
    let mut filter = SoilFilter::new(gated).unwrap();
    let transitions = twin(&model, LOAM, LOAM, 20, 1);
    for t in &transitions[..10] {
        assert!(filter.push(&model, *t).unwrap().is_none_or(|u| !u.rejected));
    }
    let before = filter.posterior();
    let mut last = None;
    for t in &transitions[10..] {
        let mut wild = *t;
        wild.measured_next[5] += 20.0;
        last = filter.push(&model, wild).unwrap().or(last);
    }
    let update = last.unwrap();
    assert!(update.rejected && chi_square_tail(update.dof, update.nis) < 1e-9);
    assert_eq!((filter.posterior(), update.posterior, filter.buffered()), (before, before, 0));
}

#[test]
fn property_bad_numbers_and_gaps_start_the_buffer_anew() {
    let model = model();
    let transitions = twin(&model, SOFT, LOAM, 19, 1);
    let mut filter = SoilFilter::new(config(SoilCoordinates::Logarithmic)).unwrap();
    for t in &transitions[..9] {
        filter.push(&model, *t).unwrap();
    }
    let before = filter.posterior();
    let mut bad = transitions[9];
    bad.measured_next[2] = f64::NAN;
    assert_eq!(filter.push(&model, bad), Err(AdaptationError::NotFinite { what: "measurement", index: 9 }));
    let mut bad = transitions[9];
    bad.input.ground[1].height_m = f64::INFINITY;
    assert_eq!(filter.push(&model, bad), Err(AdaptationError::NotFinite { what: "input", index: 0 }));
    assert_eq!((filter.posterior(), filter.buffered()), (before, 0));
    for t in &transitions[..9] {
        filter.push(&model, *t).unwrap();
    }
    filter.clear_buffer();
    for t in &transitions[9..18] {
        assert_eq!(filter.push(&model, *t), Ok(None), "no update may span a gap");
    }
    assert!(filter.push(&model, transitions[18]).unwrap().is_some());
}

#[test]
fn property_estimate_and_variance_stay_where_the_soil_can_be() {
    // Firm ground at the upper bound of n and beyond: the correction may not run on behind the bound.
    let model = model();
    let mut prior = LOAM;
    prior[4] = SOIL_BOUNDS[4].1 - 0.02;
    let mut config = config(SoilCoordinates::Logarithmic);
    config.process_sd = [0.5; 6];
    let (filter, updates) = run(config.clone(), &model, &twin(&model, SOFT, prior, 200, 2));
    for update in &updates {
        let delta = update.posterior.correction.delta;
        assert!(delta[4] <= 0.02 + 1e-12 && delta[4] >= SOIL_BOUNDS[4].0 - prior[4] - 1e-12, "{delta:?}");
        assert!((0..6).all(|i| update.posterior.covariance[i][i] <= config.prior_sd[i].powi(2) * (1.0 + 1e-9)));
    }
    assert!(filter.posterior().sd(&prior).iter().all(|sd| *sd > 0.0));
}

#[test]
fn regress_same_pushes_same_bytes() {
    let model = model();
    let bits = || {
        let (_, updates) = run(FilterConfig::default(), &model, &twin(&model, SOFT, LOAM, 100, 5));
        let numbers =
            updates.iter().flat_map(|u| u.posterior.covariance.as_flattened().to_vec().into_iter().chain(u.posterior.correction.delta));
        numbers.map(f64::to_bits).collect::<Vec<_>>()
    };
    assert_eq!(bits(), bits());
}

#[test]
fn property_unusable_settings_are_refused_by_name() {
    let refused = |config: FilterConfig| match SoilFilter::new(config) {
        Err(AdaptationError::Config { setting, .. }) => setting,
        other => panic!("{other:?}"),
    };
    let base = FilterConfig::default;
    assert_eq!(refused(FilterConfig { buffer: 0, ..base() }), "buffer");
    assert_eq!(refused(FilterConfig { prior_sd: [0.0; 6], ..base() }), "prior_sd");
    assert_eq!(refused(FilterConfig { process_sd: [f64::NAN; 6], ..base() }), "process_sd");
    assert_eq!(refused(FilterConfig { gate_tail_probability: 1.0, ..base() }), "gate_tail_probability");
    assert_eq!(refused(FilterConfig { change_probability: 1.0, ..base() }), "change_probability");
    assert_eq!(refused(FilterConfig { looks_share: 0.0, ..base() }), "looks_share");
    assert_eq!(refused(FilterConfig { looks_share: 1.5, ..base() }), "looks_share");
    assert_eq!(refused(FilterConfig { block: 3, ..base() }), "block");
    assert_eq!(refused(FilterConfig { shared_buffers: 0.5, ..base() }), "shared_buffers");
    assert_eq!(refused(FilterConfig { caution: [1.0, 1.0, 0.5, 1.0, 1.0, 1.0], ..base() }), "caution");
    assert_eq!(refused(FilterConfig { scale_memory: 0.5, ..base() }), "scale_memory");
    assert_eq!(refused(FilterConfig { trust_memory: -1.0, ..base() }), "trust_memory");
    assert_eq!(refused(FilterConfig { trust_log_odds: f64::NAN, ..base() }), "trust_log_odds");
    assert_eq!(refused(FilterConfig { linearisations: 0, ..base() }), "linearisations");
    assert_eq!(refused(FilterConfig { noise: white(0.0, 0.1).into(), ..base() }), "noise");
    assert_eq!(refused(FilterConfig { classes: 0, ..base() }), "classes");
    assert_eq!(refused(FilterConfig { class_share: 1.5, ..base() }), "class_share");
    assert_eq!(refused(FilterConfig { tail_dof: -1.0, ..base() }), "tail_dof");
    assert_eq!(refused(FilterConfig { excitation_min: f64::NAN, ..base() }), "excitation_min");
    let all_of_it = SharedError { covariance: DMatrix::identity(12, 12), correlation: 0.5 };
    assert_eq!(refused(FilterConfig { shared_error: Some(all_of_it), ..base() }), "shared_error");
}

#[test]
fn property_rollouts_and_means_of_steps_find_the_soil_too() {
    // The twin's states are exact, so a rollout from the first of a buffer errs by the noise of the measured velocities alone.
    let model = model();
    let coordinates = SoilCoordinates::Logarithmic;
    for block in [1, 5] {
        // Process noise and scale as they ship. Without them the relinearised filter stops beside the truth and is certain of it (NIS/dof 7): ten steps from a
        // prior this far off are not linear. With rows of single steps it is still too certain (1.3), hence the wider band.
        let FilterConfig { process_sd, scale_memory, .. } = FilterConfig::default();
        let settings =
            FilterConfig { innovation: Innovation::Rollout, block, process_sd, scale_memory, ..config(SoilCoordinates::Logarithmic) };
        let (mut nis, mut buffers, mut error, mut at_start) = (0.0, 0, 0.0, 0.0);
        for seed in 0..6 {
            let transitions = twin(&model, SOFT, LOAM, 300, seed);
            let (filter, updates) = run(settings.clone(), &model, &transitions);
            // Several soils move the vehicle alike, so the estimate is judged by what it predicts; one step ahead, on the same drive.
            let truth = coordinates.between(&LOAM, &SOFT);
            let away = |delta: [f64; SOIL_DIM]| -> f64 {
                let of = |t: &BufferedTransition, delta| predict_velocity(&model, t, &SoilCorrection { coordinates, delta }).velocity;
                let squared = |t: &BufferedTransition| {
                    let (a, b) = (of(t, delta), of(t, truth));
                    (0..VELOCITY_DIM).map(|c| ((a[c] - b[c]) / NOISE[c / 3]).powi(2)).sum::<f64>()
                };
                (transitions.iter().map(squared).sum::<f64>() / transitions.len() as f64).sqrt()
            };
            error += away(filter.posterior().correction.delta) / 6.0;
            at_start += away([0.0; SOIL_DIM]) / 6.0;
            assert!(updates.iter().all(|u| u.dof == 60 / block && u.innovation.len() == u.dof));
            nis += updates[5..].iter().map(|u| u.nis / u.dof as f64).sum::<f64>();
            buffers += updates.len() - 5;
        }
        let nis = nis / f64::from(buffers as u32);
        println!("block {block}: prediction error {at_start:.3} -> {error:.3} noise widths, NIS/dof {nis:.3}");
        assert!(error < 0.3 * at_start, "block {block}: {error} of {at_start}");
        assert!((0.8..if block == 1 { 1.5 } else { 1.25 }).contains(&nis), "block {block}: {nis}");
    }
}

#[test]
fn property_a_correction_is_used_where_it_helps_and_not_where_the_prior_is_right() {
    let model = model();
    let trusting = FilterConfig { innovation: Innovation::Rollout, block: 5, ..config(SoilCoordinates::Logarithmic) };
    let doubting = FilterConfig { trust_memory: 10.0, trust_log_odds: -2.0, ..trusting };
    for seed in 0..4 {
        let last = |soil| run(doubting.clone(), &model, &twin(&model, soil, LOAM, 200, seed)).1.pop().unwrap();
        let (soft, loam) = (last(SOFT), last(LOAM));
        assert!(soft.trust > 0.95, "seed {seed}: {}", soft.trust);
        assert!(loam.trust < 0.3, "seed {seed}: {}", loam.trust);
        let learned = [soft, loam].map(|update| update.posterior.learned);
        assert!(learned[0].contains(&true) && !learned[1].contains(&true), "seed {seed}: {learned:?}");
    }
}

/// Goal: the covariance that goes out is that of the mixture, wider where the model errs more than it should. Method: a filter before any drive, and after one whose noise is
/// five times what it was told, against its own covariance, trust and scale.
#[test]
fn analytic_the_band_that_goes_out_follows_trust_and_scale() {
    let model = model();
    let told = white(0.2 * NOISE[0], 0.2 * NOISE[1]).into();
    let config = FilterConfig {
        noise: told,
        scale_memory: 5.0,
        trust_memory: 10.0,
        trust_log_odds: -4.0,
        looks_share: 0.65,
        ..config(SoilCoordinates::Logarithmic)
    };
    let fresh = SoilFilter::new(config.clone()).unwrap();
    let weight = 1.0 / (1.0 + 4.0_f64.exp());
    let (own, out) = (fresh.covariance(), fresh.posterior().covariance);
    for i in 0..6 {
        assert!((out[i][i] / own[(i, i)] - (weight + (1.0 - weight) * 0.65)).abs() < 1e-12);
    }
    let (filter, updates) = run(config, &model, &twin(&model, LOAM, LOAM, 200, 1));
    let (own, posterior, weight) = (filter.covariance(), filter.posterior(), updates.last().unwrap().trust);
    assert!(filter.snapshot().noise_scale > 4.0, "widened by four at most");
    for i in 0..6 {
        let between = weight * (1.0 - weight) * filter.estimate().delta[i].powi(2);
        let expected = 4.0 * (weight + (1.0 - weight) * 0.65) * own[(i, i)] + between;
        assert!((posterior.covariance[i][i] / expected - 1.0).abs() < 1e-12, "{i}");
    }
}

#[test]
fn property_noise_that_is_larger_than_told_is_found_by_the_scale() {
    // Told a fifth of the noise that there is: without the scale NIS over its degrees of freedom is near 25.
    let model = model();
    let told = white(0.2 * NOISE[0], 0.2 * NOISE[1]).into();
    let following = FilterConfig { noise: told, scale_memory: 5.0, ..config(SoilCoordinates::Logarithmic) };
    let of_drive = |seed: u64| {
        let (_, updates) = run(following.clone(), &model, &twin(&model, LOAM, LOAM, 400, seed));
        let late = &updates[15..];
        let nis = late.iter().map(|u| u.nis / u.dof as f64).sum::<f64>() / late.len() as f64;
        (nis, late.last().unwrap().noise_scale)
    };
    let (mean, scale) = (1..=4).map(of_drive).fold((0.0, 0.0), |sum, of| (sum.0 + of.0 / 4.0, sum.1 + of.1 / 4.0));
    assert!((0.85..1.15).contains(&mean) && (18.0..33.0).contains(&scale), "{mean} {scale}");
}

#[test]
fn property_a_tempered_update_learns_less_and_judges_alike() {
    let model = model();
    let transitions = twin(&model, SOFT, LOAM, 10, 1);
    let of = |shared_buffers| {
        // One linearisation, at the same point for both: further ones are made elsewhere and need not be ordered.
        let once = FilterConfig { shared_buffers, linearisations: 1, ..config(SoilCoordinates::Logarithmic) };
        let (filter, updates) = run(once, &model, &transitions);
        (filter.posterior(), updates[0].nis)
    };
    let ((once, nis), (tempered, same_nis)) = (of(1.0), of(4.0));
    assert_eq!(nis, same_nis);
    assert!(
        (0..SOIL_DIM).all(|i| tempered.covariance[i][i] >= once.covariance[i][i] * (1.0 - 1e-9))
            && tempered.covariance[0][0] > once.covariance[0][0]
    );
}

#[test]
fn property_noise_and_shared_evidence_are_found_again() {
    // 300 drives of 20 buffers; the errors of a drive share 0.2 of their standard deviation of 0.224, seed 2.
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let mut drives = |by_drive: bool| -> Vec<Vec<UncorrectedBuffer>> {
        (0..300)
            .map(|_| {
                let carried = 0.2 * normal();
                (0..20)
                    .map(|_| {
                        let common = if by_drive { carried } else { 0.2 * normal() };
                        let innovation = DVector::from_fn(12, |_, _| common + 0.1 * normal());
                        UncorrectedBuffer { innovation, jacobian: DMatrix::from_element(12, SOIL_DIM, 1.0), conditions: [0.0; 4] }
                    })
                    .collect()
            })
            .collect()
    };
    let (apart, shared) = (drives(false), drives(true));
    let unit = FilterConfig { prior_sd: [1.0; SOIL_DIM], ..FilterConfig::default() };
    for (found, wanted) in [(calibrate(&apart, &unit, false).unwrap(), 1.0), (calibrate(&shared, &unit, false).unwrap(), 20.0)] {
        let BufferNoise::Sampled(moment) = &found.noise else { panic!("{found:?}") };
        assert!((moment[(0, 0)] - 0.05).abs() < 8e-3 && (moment[(3, 8)] - 0.04).abs() < 8e-3, "{moment}");
        assert!((found.shared_buffers / wanted - 1.0).abs() < 0.2, "{} {wanted}", found.shared_buffers);
        // The same as a state: all of the common 0.04, up to the 0.9 that a direction may lose, or none.
        let SharedError { covariance, correlation } = &found.shared_error;
        assert!(
            if wanted > 1.0 { covariance[(0, 5)] > 0.033 && *correlation > 0.9 } else { (covariance[(0, 5)] * correlation).abs() < 3e-3 },
            "{covariance} {correlation}"
        );
        assert_eq!(found.buffers, 6000);
    }
    let noise = calibrate(&apart, &unit, false).unwrap().noise;
    assert!(SoilFilter::new(FilterConfig { noise: noise.clone(), buffer: 10, block: 5, ..FilterConfig::default() }).is_ok());
    let misfit = SoilFilter::new(FilterConfig { noise, buffer: 20, block: 5, ..FilterConfig::default() });
    assert!(matches!(misfit, Err(AdaptationError::Config { setting: "noise", .. })), "{misfit:?}");
    let few = calibrate(&apart[..5], &unit, false);
    assert_eq!(few, Err(AdaptationError::TooFewBuffers { found: 100, needed: 120 }));
}
