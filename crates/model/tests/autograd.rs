//! Goal: candle's autograd and the dual numbers of the physics give the same derivatives of the wheel's stress integrals.
//! Method: the integrals written a second time, in tensors of f64, after Wong & Reece (1967), Janosi & Hanamoto (1961) and the slip of
//! `WheelMotion`; one backward pass for each output against `Dual<f64, 10>` through `wheel_wrench`. Tensors have no arc functions, so the
//! tensors start from the entry angle and the physics from the sinkage that belongs to it: its arc tangent is checked along the way.
//!
//! A deviation is |got - want| / (|want| + rms of the column over the samples), as in the agreement tests of `nesam-physics`.

use candle_core::{DType, Device, Result, Tensor, Var};
use nesam_physics::scalar::Dual;
use nesam_physics::terramechanics::{WheelGeometry, WheelMotion, wheel_wrench};
use nesam_physics::{Real, Soil};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

const SAMPLES: usize = 64;
const INPUTS: usize = 10;
const OUTPUTS: usize = 5;
const SEED: u64 = 20_262;
/// Speed below which slip is regularised, m/s.
const SLIP_SPEED_FLOOR_M_S: f64 = 0.05;
/// Shear displacement below which its direction is smoothed, m.
const SHEAR_FLOOR_M: f64 = 1e-6;

/// Ranges of entry angle, rim, forward and left speed, and the logarithms of the soil k_phi, k_c, n, c, phi, k_shear.
fn ranges() -> [(f64, f64); INPUTS] {
    let log = |low: f64, high: f64| (low.ln(), high.ln());
    [
        (0.12, 0.9),
        (-3.0, 6.0),
        (-3.0, 6.0),
        (-1.0, 1.0),
        log(3e5, 5e6),
        log(1e3, 5e4),
        log(0.3, 1.4),
        log(5e2, 2e4),
        log(0.1, 0.7),
        log(0.005, 0.05),
    ]
}

/// Inputs by column: `[input][sample]`.
fn columns() -> Vec<Vec<f64>> {
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    ranges().iter().map(|(low, high)| (0..SAMPLES).map(|_| random.random_range(*low..*high)).collect()).collect()
}

/// The physics of one sample: thrust, resistance, side force, load, torque.
fn by_physics<T: Real>(wheel: &WheelGeometry, x: [T; INPUTS]) -> [T; OUTPUTS] {
    let sinkage = (T::lit(1.0) - x[0].sin_cos().1) * T::lit(wheel.radius_m);
    let motion = WheelMotion { rim_speed_m_s: x[1], forward_m_s: x[2], left_m_s: x[3] }.contact().1;
    let soil = Soil { k_phi: x[4].exp(), k_c: x[5].exp(), n: x[6].exp(), c: x[7].exp(), phi: x[8].exp(), k_shear: x[9].exp() };
    let w = wheel_wrench(wheel, sinkage, &motion, &soil);
    [w.thrust_n, w.resistance_n, w.side_n, w.normal_n, w.torque_n_m]
}

/// sqrt(x² + eps²).
fn abs_smooth(x: &Tensor, eps: f64) -> Result<Tensor> {
    (x.sqr()? + eps * eps)?.sqrt()
}

/// Slip in [-1, 1] and the ratios of rim, travel and lateral speed to the smoothed rim speed, each of shape (samples).
struct Ratios {
    slip: Tensor,
    rim: Tensor,
    travel: Tensor,
    lateral: Tensor,
}

fn ratios(rim_m_s: &Tensor, forward_m_s: &Tensor, left_m_s: &Tensor) -> Result<Ratios> {
    let sum = (rim_m_s + forward_m_s)?;
    let direction = (&sum / abs_smooth(&sum, SLIP_SPEED_FLOOR_M_S)?)?;
    let (rim, travel) = ((&direction * rim_m_s)?, (&direction * forward_m_s)?);
    let size = abs_smooth(&rim, SLIP_SPEED_FLOOR_M_S)?;
    let slip = ((&rim - &travel)? / abs_smooth(&rim.maximum(&travel)?, SLIP_SPEED_FLOOR_M_S)?)?;
    let one = slip.ones_like()?;
    let slip = slip.maximum(&one.neg()?)?.minimum(&one)?;
    Ok(Ratios { slip, travel: (travel / &size)?, lateral: (left_m_s / &size)?, rim: (rim / size)? })
}

/// The same in tensors of shape (samples), for a wheel in soil that does not spring back.
fn by_tensors(wheel: &WheelGeometry, x: &[Var]) -> Result<Vec<Tensor>> {
    let (radius, entry) = (wheel.radius_m, x[0].as_tensor());
    let ratios = ratios(&x[1], &x[2], &x[3])?;
    let [k_phi, k_c, n, c, phi, k_shear] = [4, 5, 6, 7, 8, 9].map(|i: usize| x[i].exp());
    let (k_phi, k_c, n, c, phi, k_shear) = (k_phi?, k_c?, n?, c?, phi?, k_shear?);
    let modulus = ((k_c / wheel.width_m)? + k_phi)?;
    let tan_phi = (phi.sin()? / phi.cos()?)?;
    let (sin_entry, cos_entry) = (entry.sin()?, entry.cos()?);
    let peak = (entry * ((abs_smooth(&ratios.slip, 1e-9)? * wheel.c2)? + wheel.c1)?)?;
    let (front, rear) = ((entry - &peak)?, peak);
    let mut sums = vec![entry.zeros_like()?; OUTPUTS];
    for &(t2, weight) in wheel.rule.nodes() {
        let theta_front = (entry - (&front * t2)?)?;
        let depth = ((theta_front.cos()? - &cos_entry)? * radius)?;
        let sigma = (&modulus * (depth.log()? * &n)?.exp()?)?;
        let strength = (&c + (&sigma * &tan_phi)?)?;
        for (theta, arc) in [(theta_front, &front), ((&rear * t2)?, &rear)] {
            let (sin, cos) = (theta.sin()?, theta.cos()?);
            let swept = (entry - &theta)?;
            let j_x = (((&ratios.rim * &swept)? - (&ratios.travel * (&sin_entry - &sin)?)?)? * radius)?;
            let j_y = ((&ratios.lateral * &swept)? * radius)?;
            let j = ((j_x.sqr()? + j_y.sqr()?)? + SHEAR_FLOOR_M * SHEAR_FLOOR_M)?.sqrt()?;
            let mobilised = ((&strength * (1.0 - (&j / &k_shear)?.neg()?.exp()?)?)? / &j)?;
            let (tau_x, tau_y) = ((&mobilised * &j_x)?, (&mobilised * &j_y)?);
            let w = (arc * (weight * radius * wheel.width_m))?;
            let parts = [(&tau_x * &cos)?, (&sigma * &sin)?, tau_y.neg()?, ((&sigma * &cos)? + (&tau_x * &sin)?)?, (&tau_x * radius)?];
            for (sum, part) in sums.iter_mut().zip(parts) {
                *sum = (&*sum + (part * &w)?)?;
            }
        }
    }
    Ok(sums)
}

/// Largest deviation of two columns of samples.
fn deviation(got: &[f64], want: &[f64]) -> f64 {
    assert_eq!(got.len(), want.len());
    let rms = (want.iter().map(|w| w * w).sum::<f64>() / want.len() as f64).sqrt();
    assert!(rms > 0.0, "a column of zeros proves nothing");
    got.iter().zip(want).map(|(g, w)| (g - w).abs() / (w.abs() + rms)).fold(0.0, f64::max)
}

#[test]
fn property_autograd_agrees_with_duals_on_a_wheel() {
    let wheel = WheelGeometry::new(0.467, 0.254);
    let columns = columns();
    let inputs: Vec<Var> = columns
        .iter()
        .map(|column| Var::from_tensor(&Tensor::new(column.as_slice(), &Device::Cpu).expect("a tensor")).expect("a variable"))
        .collect();
    assert!(inputs.iter().all(|x| x.dtype() == DType::F64));
    let outputs = by_tensors(&wheel, &inputs).expect("tensors of one shape");
    let duals: Vec<[Dual<f64, INPUTS>; OUTPUTS]> =
        (0..SAMPLES).map(|s| by_physics(&wheel, core::array::from_fn(|i| Dual::variable(columns[i][s], i)))).collect();
    // Both round a few hundred operations of f64, and the smallest depths lose three digits to cancellation; the physics ends the contact 1e-12 rad
    // behind the lowest point, the tensors at it.
    let (values_tolerance, gradient_tolerance) = (1e-10, 1e-8);
    for (k, output) in outputs.iter().enumerate() {
        let values = output.to_vec1::<f64>().expect("readable");
        let want: Vec<f64> = duals.iter().map(|d| d[k].re).collect();
        let worst = deviation(&values, &want);
        assert!(worst < values_tolerance, "output {k}: {worst:.1e}");
        let gradients = output.sum_all().and_then(|sum| sum.backward()).expect("differentiable");
        for (i, input) in inputs.iter().enumerate() {
            let want: Vec<f64> = duals.iter().map(|d| d[k].eps[i]).collect();
            let gradient = gradients.get(input).map(|gradient| gradient.to_vec1::<f64>().expect("readable"));
            if want.iter().all(|w| *w == 0.0) {
                // The normal stress knows no shear: the compaction resistance has no derivative by c, phi, k_shear and the side speed.
                assert!(k == 1 && gradient.is_none_or(|g| g.iter().all(|g| *g == 0.0)), "derivative of output {k} by input {i}");
                continue;
            }
            let worst = deviation(&gradient.expect("an input that counts"), &want);
            println!("output {k}, input {i}: {worst:.1e}");
            assert!(worst < gradient_tolerance, "derivative of output {k} by input {i}: {worst:.1e}");
        }
    }
}
