//! Goal: one text of the physics, one result: every scalar computes the same numbers and the same derivatives.
//! Method: the same seeded inputs, a wheel alone and a full step of a truck and of a robot, through `f64`, `f32`, `f32x8`,
//! `Dual<f64, N>`, `Dual<f32x8, N>`, through num-dual (an independent implementation of dual numbers), and through central
//! differences. Candle's autograd is compared with the same duals where tensors live, in `crates/model/tests/autograd.rs`.
//!
//! A deviation is |got - want| / (|want| + rms of the column over the samples): relative where a number is of its usual size,
//! and measured against that size where it happens to be small. Columns are outputs, or single derivatives ∂output/∂input.

mod common;
#[path = "common/oracle_dual.rs"]
mod oracle_dual;

use common::{INPUTS, VARIABLES, spread, unflatten};
use nesam_physics::scalar::{Dual, f32x8};
use nesam_physics::step::StepModel;
use nesam_physics::terramechanics::{WheelGeometry, WheelMotion, wheel_wrench};
use nesam_physics::{DT_S, Real, Soil, Vehicle};
use nesam_test_vehicles::{robot, torque_truck, truck};
use oracle_dual::Nd;

const LANES: usize = 8;
/// Samples of each case, a multiple of the lanes.
const SAMPLES: usize = 512;
const WHEEL_INPUTS: usize = 10;
const SEED: u64 = 20_261;
/// Load above which the iterated load balance has settled, N: see [`Case::settled`].
const SETTLED_LOAD_N: f64 = 4.0;

/// SplitMix64 (Steele et al. 2014): numbers in [0, 1).
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// A function of `X` numbers under test, over any scalar; the first `N` are differentiated.
trait Case<const X: usize, const N: usize, const Y: usize> {
    fn samples(&self) -> Vec<[f64; X]>;
    fn outputs<T: Real>(&self, x: &[T; X]) -> [T; Y];
    /// Step of the central difference of input `i`.
    fn difference_step(&self, i: usize) -> f64;
    /// Whether differences of the computed function can be those of the exact one.
    ///
    /// The load balance makes three steps and gives the derivative of the equation that it solves. Where a wheel of the step is
    /// within a few newtons of lifting off, three steps do not settle, and the two differ (forty steps bring them to 1e-7).
    fn settled(&self, x: &[f64; X]) -> bool;
}

/// Thrust, resistance, side force, load, torque of (ln sinkage, rim, forward, left speed, ln soil).
struct WheelCase(WheelGeometry);

impl Case<WHEEL_INPUTS, WHEEL_INPUTS, 5> for WheelCase {
    fn samples(&self) -> Vec<[f64; WHEEL_INPUTS]> {
        let mut random = Random(SEED);
        let ranges = [
            (f64::ln(3e-3), f64::ln(0.2)),
            (-3.0, 6.0),
            (-3.0, 6.0),
            (-1.0, 1.0),
            (f64::ln(3e5), f64::ln(5e6)),
            (f64::ln(1e3), f64::ln(5e4)),
            (f64::ln(0.3), f64::ln(1.4)),
            (f64::ln(5e2), f64::ln(2e4)),
            (f64::ln(0.1), f64::ln(0.7)),
            (f64::ln(0.005), f64::ln(0.05)),
        ];
        (0..SAMPLES).map(|_| ranges.map(|(low, high)| low + (high - low) * random.unit())).collect()
    }

    fn outputs<T: Real>(&self, x: &[T; WHEEL_INPUTS]) -> [T; 5] {
        let motion = WheelMotion { rim_speed_m_s: x[1], forward_m_s: x[2], left_m_s: x[3] }.contact().1;
        let soil = Soil { k_phi: x[4].exp(), k_c: x[5].exp(), n: x[6].exp(), c: x[7].exp(), phi: x[8].exp(), k_shear: x[9].exp() };
        let w = wheel_wrench(&self.0, x[0].exp(), &motion, &soil);
        [w.thrust_n, w.resistance_n, w.side_n, w.normal_n, w.torque_n_m]
    }

    fn difference_step(&self, _: usize) -> f64 {
        1e-5
    }

    fn settled(&self, _: &[f64; WHEEL_INPUTS]) -> bool {
        true
    }
}

/// Twelve increments, four sinkages, four loads of a step (see `common::unflatten` for the inputs).
struct StepCase {
    model: StepModel,
    first_substep: StepModel,
}

impl StepCase {
    fn new(vehicle: &Vehicle) -> Self {
        Self { model: StepModel::new(vehicle, DT_S, 2), first_substep: StepModel::new(vehicle, 0.5 * DT_S, 1) }
    }
}

impl Case<INPUTS, VARIABLES, 20> for StepCase {
    fn samples(&self) -> Vec<[f64; INPUTS]> {
        let mut random = Random(SEED + 1);
        (0..SAMPLES).map(|_| spread(self.model.vehicle(), &core::array::from_fn::<f64, INPUTS, _>(|_| random.unit()))).collect()
    }

    fn outputs<T: Real>(&self, x: &[T; INPUTS]) -> [T; 20] {
        let out = self.model.step(&unflatten(self.model.vehicle(), x));
        let increment = out.increment.to_array();
        core::array::from_fn(|k| match k {
            0..12 => increment[k],
            12..16 => out.contacts[k - 12].sinkage_m,
            _ => out.contacts[k - 16].normal_n,
        })
    }

    fn difference_step(&self, i: usize) -> f64 {
        // The contact law bends within tens of micrometres at lift-off, the slip within centimetres per second.
        if i < 3 { 1e-7 } else { 1e-6 }
    }

    fn settled(&self, x: &[f64; INPUTS]) -> bool {
        let input = unflatten(self.model.vehicle(), x);
        [&self.model, &self.first_substep].iter().all(|m| m.step(&input).contacts.iter().all(|c| c.normal_n > SETTLED_LOAD_N))
    }
}

/// Values, or derivatives, of every sample: `[sample][column]`.
type Table = Vec<Vec<f64>>;

fn values<T: Real, const X: usize, const N: usize, const Y: usize>(case: &impl Case<X, N, Y>, to_f64: fn(T) -> f64) -> Table {
    let run = |x: [f64; X]| case.outputs(&x.map(T::lit)).map(to_f64).to_vec();
    case.samples().into_iter().map(run).collect()
}

/// Value and gradient of a dual number, in f64.
type Split<T, const N: usize> = fn(T) -> (f64, [f64; N]);

fn dual_tables<T: Real, const X: usize, const N: usize, const Y: usize>(
    case: &impl Case<X, N, Y>,
    variable: fn(f64, usize) -> T,
    split: Split<T, N>,
) -> (Table, Table) {
    let run = |x: [f64; X]| {
        let inputs: [T; X] = core::array::from_fn(|i| if i < N { variable(x[i], i) } else { T::lit(x[i]) });
        let outputs = case.outputs(&inputs).map(split);
        (outputs.iter().map(|o| o.0).collect(), outputs.iter().flat_map(|o| o.1).collect())
    };
    case.samples().into_iter().map(run).unzip()
}

/// Eight samples side by side, as training and batched inference run them.
fn lane_inputs<const X: usize>(samples: &[[f64; X]]) -> [f32x8; X] {
    core::array::from_fn(|i| f32x8::new(core::array::from_fn(|lane| samples[lane][i] as f32)))
}

fn lanes<const X: usize, const N: usize, const Y: usize>(case: &impl Case<X, N, Y>) -> Table {
    let run = |chunk: &[[f64; X]]| {
        let outputs = case.outputs(&lane_inputs(chunk)).map(|o| o.to_array());
        (0..LANES).map(|lane| outputs.iter().map(|o| f64::from(o[lane])).collect()).collect::<Table>()
    };
    case.samples().chunks(LANES).flat_map(run).collect()
}

fn dual_lanes<const X: usize, const N: usize, const Y: usize>(case: &impl Case<X, N, Y>) -> (Table, Table) {
    let run = |chunk: &[[f64; X]]| {
        let inputs = lane_inputs(chunk);
        let inputs: [Dual<f32x8, N>; X] =
            core::array::from_fn(|i| if i < N { Dual::variable(inputs[i], i) } else { Dual::constant(inputs[i]) });
        let outputs = case.outputs(&inputs);
        let of_lane = |lane: usize| -> (Vec<f64>, Vec<f64>) {
            let pick = |v: f32x8| f64::from(v.to_array()[lane]);
            (outputs.iter().map(|o| pick(o.re)).collect(), outputs.iter().flat_map(|o| o.eps.map(pick)).collect())
        };
        (0..LANES).map(of_lane).collect::<Vec<_>>()
    };
    case.samples().chunks(LANES).flat_map(run).unzip()
}

fn central_differences<const X: usize, const N: usize, const Y: usize>(case: &impl Case<X, N, Y>) -> Table {
    let run = |x: [f64; X]| {
        let mut columns = vec![0.0; Y * N];
        for i in 0..N {
            let h = case.difference_step(i);
            let at = |shift: f64| {
                let mut moved = x;
                moved[i] += shift;
                case.outputs(&moved)
            };
            let (ahead, behind) = (at(h), at(-h));
            for k in 0..Y {
                columns[k * N + i] = (ahead[k] - behind[k]) / (2.0 * h);
            }
        }
        columns
    };
    case.samples().into_iter().map(run).collect()
}

/// Prints the deviation of two tables, and demands its median and its maximum.
fn agree(what: &str, got: &Table, want: &Table, median: f64, maximum: f64) {
    assert_eq!(got.len(), want.len());
    let columns = want[0].len();
    let scale: Vec<f64> = (0..columns).map(|k| (want.iter().map(|row| row[k] * row[k]).sum::<f64>() / want.len() as f64).sqrt()).collect();
    let largest = scale.iter().fold(0.0, |a: f64, &b| a.max(b));
    let mut deviations: Vec<(f64, usize, usize)> = Vec::new();
    for (s, (g, w)) in got.iter().zip(want).enumerate() {
        assert_eq!(g.len(), columns);
        for k in 0..columns {
            // Columns that are zero but for rounding have no size of their own.
            let size = w[k].abs() + scale[k] + 1e-9 * largest;
            let deviation = (g[k] - w[k]).abs() / size;
            assert!(deviation.is_finite(), "{what}: sample {s}, column {k}: {} against {}", g[k], w[k]);
            deviations.push((deviation, s, k));
        }
    }
    deviations.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (middle, worst) = (deviations[deviations.len() / 2].0, deviations[deviations.len() - 1]);
    let p999 = deviations[deviations.len() * 999 / 1000].0;
    println!("{what:<44} median {middle:.1e}, 99.9 % {p999:.1e}, max {:.1e} (sample {}, column {})", worst.0, worst.1, worst.2);
    assert!(middle <= median && worst.0 <= maximum, "{what}: median {middle:.1e} of {median:.1e}, worst {worst:?} of {maximum:.1e}");
}

/// Tolerances as (median, maximum).
struct Tolerance {
    f32_values: (f64, f64),
    f32_derivatives: (f64, f64),
    differences: (f64, f64),
}

fn all_scalars_agree<const X: usize, const N: usize, const Y: usize>(name: &str, case: &impl Case<X, N, Y>, tolerance: &Tolerance) {
    let reference = values::<f64, X, N, Y>(case, |v| v);
    let (dual_values, derivatives) = dual_tables(case, Dual::<f64, N>::variable, |d| (d.re, d.eps));
    // The value part of a dual runs the very operations of a float, except for 1/x instead of a division: rounding only.
    let exact = (1e-13, 1e-9);
    agree(&format!("{name}: Dual<f64> values"), &dual_values, &reference, exact.0, exact.1);
    let (nd_values, nd_derivatives) = dual_tables(case, Nd::<N>::variable, |d| (d.value(), d.gradient()));
    agree(&format!("{name}: num-dual values"), &nd_values, &reference, exact.0, exact.1);
    agree(&format!("{name}: num-dual derivatives"), &nd_derivatives, &derivatives, exact.0, exact.1);
    let settled: Vec<bool> = case.samples().iter().map(|x| case.settled(x)).collect();
    let only_settled = |table: &Table| -> Table { table.iter().zip(&settled).filter(|(_, s)| **s).map(|(row, _)| row.clone()).collect() };
    let (differences, exact_differences) = (only_settled(&central_differences(case)), only_settled(&derivatives));
    assert!(differences.len() >= 200, "{} settled samples", differences.len());
    let (median, maximum) = tolerance.differences;
    let what = format!("{name}: central differences ({})", differences.len());
    agree(&what, &differences, &exact_differences, median, maximum);

    let (median, maximum) = tolerance.f32_values;
    agree(&format!("{name}: f32 values"), &values::<f32, X, N, Y>(case, f64::from), &reference, median, maximum);
    agree(&format!("{name}: f32x8 values"), &lanes(case), &reference, median, maximum);
    let (lane_values, lane_derivatives) = dual_lanes(case);
    agree(&format!("{name}: Dual<f32x8> values"), &lane_values, &reference, median, maximum);
    let (median, maximum) = tolerance.f32_derivatives;
    agree(&format!("{name}: Dual<f32x8> derivatives"), &lane_derivatives, &derivatives, median, maximum);
}

/// A wheel: f32 rounds to 6e-8 and a hundred operations follow; differences of step 1e-5 keep about eight digits.
const WHEEL_TOLERANCE: Tolerance = Tolerance { f32_values: (3e-7, 1e-5), f32_derivatives: (3e-7, 2e-5), differences: (1e-10, 1e-6) };

/// A step: the contact is stiff (a micrometre of height is a tenth of a newton) and lifts off within a tenth of a millimetre, which
/// amplifies the rounding of f32: the maxima are those of wheels at lift-off, where the derivative jumps from nothing to the full
/// stiffness. Differences see what the steps of the load balance leave.
const STEP_TOLERANCE: Tolerance = Tolerance { f32_values: (1e-6, 1e-3), f32_derivatives: (3e-6, 0.1), differences: (3e-7, 4e-3) };

/// A step under the soil contact model: the load balance has settled where wheels carry, and single precision does without its last step.
const SETTLED_TOLERANCE: Tolerance = Tolerance { f32_values: (1e-6, 2e-3), differences: (3e-8, 1e-5), ..STEP_TOLERANCE };

#[test]
fn property_scalars_agree_on_a_wheel() {
    all_scalars_agree("wheel", &WheelCase(WheelGeometry::new(0.467, 0.254)), &WHEEL_TOLERANCE);
}

#[test]
fn property_scalars_agree_on_a_wheel_with_side_bulldozing() {
    let wheel = WheelGeometry { side_soil_unit_weight_n_m3: Some(15e3), recovery: 0.1, ..WheelGeometry::new(0.467, 0.254) };
    all_scalars_agree("bulldozing", &WheelCase(wheel), &WHEEL_TOLERANCE);
}

#[test]
fn property_scalars_agree_on_a_step_of_the_truck() {
    all_scalars_agree("truck", &StepCase::new(&truck()), &STEP_TOLERANCE);
}

#[test]
fn property_scalars_agree_on_a_step_of_the_truck_under_torque() {
    all_scalars_agree("torque truck", &StepCase::new(&torque_truck()), &SETTLED_TOLERANCE);
}

#[test]
fn property_scalars_agree_on_a_step_of_the_robot() {
    all_scalars_agree("robot", &StepCase::new(&robot()), &STEP_TOLERANCE);
}
