//! Goal: contact and soil follow each constitutive effect. Method: closed forms of the laws, contact forces of one sub-step.

use nesam_physics::effects::*;
use nesam_physics::terramechanics::{ContactMotion, Support, WheelGeometry, balance_sinkage, bekker_sinkage, front_bulldozing};
use nesam_test_vehicles::{robot, truck};

use crate::common::{Drive, loam};
use crate::force::first_contacts;
use crate::settle;

fn terms(effect: Effect) -> SoilTerms {
    let mut terms = EffectTerms::default();
    effect.add_to(&mut terms);
    terms.soil
}

#[test]
fn analytic_slip_sinkage_grows_with_the_slip() {
    // Rims that run ahead of a slow vehicle, against the balance of the load that each wheel carries.
    let per_slip = 0.5;
    let wheel = WheelGeometry::new(0.467, 0.254);
    for contact in first_contacts(&[Effect::SlipSinkage(SlipSinkage { per_slip })], 6.0, 0.0, 0.0) {
        assert!(contact.slip > 0.1, "{}", contact.slip);
        let support = Support { preload_n: contact.normal_n, rate_n_m: 0.0 };
        let balanced = balance_sinkage(&wheel, &support, &ContactMotion::from_slip(contact.slip, 0.0), &loam());
        let ratio = contact.sinkage_m / balanced;
        assert!((ratio / (1.0 + per_slip * contact.slip) - 1.0).abs() < 0.01, "{ratio} at slip {}", contact.slip);
    }
}

#[test]
fn analytic_hardened_ruts_bear_the_rear_wheels_as_bekker_says() {
    let at_rest = |effects: &[Effect]| {
        let mut drive = Drive::new(truck().with_effects(effects), 0.0);
        (0..80).for_each(|_| {
            drive.step(0.0, 0.0);
        });
        drive.step(0.0, 0.0).contacts
    };
    let [with, without] = [vec![Effect::MultiPass(MultiPass { relative: 0.5 })], vec![]].map(|effects| at_rest(&effects));
    let soil = loam();
    for i in 0..2 {
        assert!((with[i].sinkage_m / without[i].sinkage_m - 1.0).abs() < 0.01);
    }
    let firmer = nesam_physics::Soil { k_phi: 1.5 * soil.k_phi, k_c: 1.5 * soil.k_c, ..soil };
    let want = bekker_sinkage(6000.0, 0.467, 0.254, &firmer) / bekker_sinkage(6000.0, 0.467, 0.254, &soil);
    for i in 2..4 {
        let ratio = with[i].sinkage_m / without[i].sinkage_m;
        assert!((ratio / want - 1.0).abs() < 0.06, "{ratio} {want}");
    }
}

#[test]
fn property_recovery_and_pressure_further_ahead_carry_the_wheel_higher_or_lower() {
    let mean = |effects: &[Effect]| first_contacts(effects, 2.0, 0.0, 0.0).iter().map(|c| c.sinkage_m).sum::<f64>();
    assert!(
        mean(&[Effect::ElasticRecovery(ElasticRecovery { lambda: 0.2 })]) < mean(&[]),
        "soil that springs back bears behind the axle too"
    );
    let [ahead, behind] = [0.1, -0.1].map(|c1| mean(&[Effect::ThetaMShift(ThetaMShift { c1 })]));
    assert!((ahead - mean(&[])) * (behind - mean(&[])) < 0.0, "{ahead} {behind}");
}

#[test]
fn published_grouser_factors() {
    // h / b = 0.1 (Bekker 1969): 1 + 2 h / b = 1.2 and 1 + 0.64 (h / b) atan(b / h) = 1 + 0.064 · 1.4711 = 1.09415.
    let soil = terms(Effect::Grousers(Grousers { metres: 0.02 })).under_wheel(&loam(), 0.0, 0.2);
    assert!((soil.c / loam().c - 1.2).abs() < 1e-12);
    assert!((soil.phi.tan() / loam().phi.tan() - 1.094_15).abs() < 1e-5);
}

#[test]
fn analytic_front_bulldozing_resists_the_front_wheels() {
    let effect = Effect::FrontBulldozing(FrontBulldozing { share: 0.5, unit_weight_n_m3: 16e3 });
    let [with, without] = [vec![effect], vec![]].map(|effects| first_contacts(&effects, 2.0, 0.0, 0.0));
    for i in 0..2 {
        let want = 0.5 * front_bulldozing(0.254, without[i].sinkage_m, 16e3, &loam());
        let got = without[i].forward_n - with[i].forward_n;
        assert!((got / want - 1.0).abs() < 0.01, "{got} {want}");
    }
    assert_eq!(with[3].forward_n.to_bits(), without[3].forward_n.to_bits());
}

#[test]
fn property_side_bulldozing_opposes_sliding_in_proportion() {
    let side = |share: f64, left: f64| {
        let effect = Effect::SideBulldozing(SideBulldozing { share, unit_weight_n_m3: 16e3 });
        let [with, without] = [vec![effect], vec![]].map(|effects| first_contacts(&effects, 2.0, 0.0, left));
        with[0].left_n - without[0].left_n
    };
    let (whole, half, other) = (side(1.0, 0.3), side(0.5, 0.3), side(1.0, -0.3));
    assert!(whole < -10.0 && (half / whole - 0.5).abs() < 1e-9, "{whole} {half}");
    assert!((other / whole + 1.0).abs() < 0.05, "{whole} {other}");
}

#[test]
fn analytic_pressure_under_a_crust() {
    let (factor, thickness) = (0.4, 0.03);
    let crust = terms(Effect::SoilCrust(SoilCrust { factor, depth_m: thickness }));
    let soil = loam();
    for z in [0.01, 0.03, 0.05, 0.12] {
        let under = crust.under_crust(&soil, z);
        let above: f64 = f64::min(z, thickness).powf(soil.n);
        let want = soil.k_phi * (above + factor * (z.powf(soil.n) - above));
        assert!((under.k_phi * z.powf(soil.n) / want - 1.0).abs() < 1e-12, "depth {z}");
    }
    let (_, loads) = settle(&[Effect::SoilCrust(SoilCrust { factor, depth_m: thickness })], 0.0, 0.0, 60);
    assert!((loads.iter().sum::<f64>() / (truck().mass_kg * 9.81) - 1.0).abs() < 0.01, "a crust changes depth, not weight");
}

#[test]
fn analytic_soil_drifts_geometrically_and_stays_at_its_end() {
    let drift = terms(Effect::SoilDrift(SoilDrift { factor_end: 0.64, begin_s: 5.0, end_s: 25.0 }));
    let soil = loam().to_array();
    for (time, factor) in [(Some(0.0), 1.0), (Some(5.0), 1.0), (Some(15.0), 0.8), (Some(25.0), 0.64), (Some(90.0), 0.64), (None, 0.64)] {
        let drifted = drift.drifted(soil, time);
        for i in [0, 1, 3, 4] {
            assert!((drifted[i] / soil[i] - factor).abs() < 1e-12, "{time:?} {i}");
        }
        assert_eq!((drifted[2], drifted[5]), (soil[2], soil[5]));
    }
}

/// Goal: two entries of one effect with places of their own act both, in any order. Method: drifts at their times and crusts at their depths against one after the other;
/// shares of bulldozing of two weights against the sum of both resistances.
#[test]
fn regress_two_places_of_one_effect_do_not_overwrite_each_other() {
    let both = |effects: [Effect; 2]| {
        let mut terms = EffectTerms::default();
        effects.iter().for_each(|effect| effect.add_to(&mut terms));
        terms.soil
    };
    let drift = |factor_end: f64, begin_s: f64, end_s: f64| Effect::SoilDrift(SoilDrift { factor_end, begin_s, end_s });
    let (early, late) = (drift(0.5, 0.0, 0.1), drift(0.8, 1000.0, 2000.0));
    for drifts in [[early, late], [late, early]].map(both) {
        for (time_s, factor) in [(5.0, 0.5), (1500.0, 0.5 * 0.8f64.sqrt()), (3000.0, 0.4)] {
            let drifted = drifts.drifted(loam().to_array(), Some(time_s));
            assert!((drifted[0] / loam().k_phi - factor).abs() < 1e-12, "{time_s} s");
        }
    }
    assert_eq!(both([early, early]), terms(drift(0.25, 0.0, 0.1)), "more of the same");
    let crust = |factor: f64, depth_m: f64| Effect::SoilCrust(SoilCrust { factor, depth_m });
    let (thin, thick) = (crust(0.5, 0.02), crust(0.4, 0.06));
    for crusts in [[thin, thick], [thick, thin]].map(both) {
        let one_by_one = terms(thick).under_crust(&terms(thin).under_crust(&loam(), 0.1), 0.1);
        assert!((crusts.under_crust(&loam(), 0.1).k_phi / one_by_one.k_phi - 1.0).abs() < 1e-12);
    }
    let front = |share: f64, unit_weight_n_m3: f64| Effect::FrontBulldozing(FrontBulldozing { share, unit_weight_n_m3 });
    let [share, weight] = both([front(0.5, 15e3), front(1.0, 24e3)]).front_bulldozing;
    let of = |weight: f64| front_bulldozing(0.254, 0.05, weight, &loam());
    assert!((share * of(weight) - 0.5 * of(15e3) - of(24e3)).abs() < 1e-9, "{share} {weight}");
    let side = |share: f64, unit_weight_n_m3: f64| Effect::SideBulldozing(SideBulldozing { share, unit_weight_n_m3 });
    assert_eq!(both([side(0.5, 15e3), side(1.0, 24e3)]).side_bulldozing, [share, weight]);
}

/// Goal: backwards the rear wheels lead. Method: a robot that is the same at both ends, forwards and backwards with each effect of the leading wheels: its wheels change
/// places, and what they carry is the same.
#[test]
fn regress_backwards_the_rear_wheels_lead() {
    for effect in
        [Effect::MultiPass(MultiPass { relative: 2.0 }), Effect::FrontBulldozing(FrontBulldozing { share: 1.0, unit_weight_n_m3: 16e3 })]
    {
        let contacts = |speed: f64| {
            let mut drive = Drive::new(robot().with_effects(&[effect]), speed);
            (0..40).for_each(|_| {
                drive.step(speed, 0.0);
            });
            drive.step(speed, 0.0).contacts
        };
        let (ahead, back) = (contacts(1.0), contacts(-1.0));
        for i in 0..4 {
            let (a, b) = (ahead[i], back[i ^ 2]);
            assert!((a.sinkage_m - b.sinkage_m).abs() < 1e-9 && (a.forward_n + b.forward_n).abs() < 1e-6, "{}: {a:?} {b:?}", effect.id());
        }
        let [sinkage_m, forward_n] = [ahead[0].sinkage_m - ahead[2].sinkage_m, ahead[0].forward_n - ahead[2].forward_n];
        assert!(sinkage_m.abs() > 1e-4 || forward_n.abs() > 1.0, "{}: the leading wheels are others", effect.id());
    }
}
