//! The catalogue as hypotheses: parameters with priors, a linear form for the first look and the effect itself for the refit.

use core::ops::Range;

use nesam_physics::WHEELS;
use nesam_physics::effects::{Effect, Payload, SteeringOffset, WheelDrag};

/// Version of catalogue and linear forms; the null scores of a reference hold for one version only.
pub const CATALOGUE: &str = "2";
/// Columns of the linear form of the whole catalogue.
pub const COLUMNS: usize = 4 + WHEELS + 1;

/// One hypothesis: an effect, and for a wheel drag which wheel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Candidate {
    /// A mass carried along.
    Payload,
    /// Friction at one wheel.
    WheelDrag(usize),
    /// A constant offset of the steering.
    SteeringOffset,
}

/// A parameter that a refit estimates.
#[derive(Clone, Copy, Debug)]
pub struct Free {
    /// Index among the effect's parameters.
    pub parameter: usize,
    /// Prior mean.
    pub mean: f64,
    /// Prior standard deviation: wide, it only keeps unobservable directions in place.
    pub sd: f64,
    /// Step of the finite differences.
    pub step: f64,
}

const fn free(parameter: usize, mean: f64, sd: f64, step: f64) -> Free {
    Free { parameter, mean, sd, step }
}

/// A load lies on the floor, the bed or the roof and within the wheelbase or a little behind it (chosen).
const PAYLOAD: [Free; 4] = [free(0, 0.0, 1500.0, 100.0), free(1, 0.0, 1.5, 0.3), free(2, 0.0, 0.5, 0.2), free(3, 0.6, 0.4, 0.3)];
const WHEEL_DRAG: [Free; 1] = [free(1, 0.0, 2000.0, 100.0)];
const STEERING_OFFSET: [Free; 1] = [free(0, 0.0, 0.2, 0.02)];

/// Standard deviation of the shares of [`Candidate::linear_form`].
pub const SHARE_SD: f64 = 3.0;

impl Candidate {
    /// All hypotheses in the order of the linear columns.
    pub const ALL: [Self; WHEELS + 2] =
        [Self::Payload, Self::WheelDrag(0), Self::WheelDrag(1), Self::WheelDrag(2), Self::WheelDrag(3), Self::SteeringOffset];

    /// Id of the effect.
    pub fn id(self) -> &'static str {
        match self {
            Self::Payload => "payload",
            Self::WheelDrag(_) => "wheel_drag",
            Self::SteeringOffset => "steering_offset",
        }
    }

    /// Id and wheel, for tables.
    pub fn label(self) -> String {
        match self {
            Self::WheelDrag(i) => format!("wheel_drag {}", ["FL", "FR", "RL", "RR"][i]),
            other => other.id().into(),
        }
    }

    /// Columns of this hypothesis in the linear form of the catalogue.
    pub fn columns(self) -> Range<usize> {
        match self {
            Self::Payload => 0..4,
            Self::WheelDrag(i) => 4 + i..5 + i,
            Self::SteeringOffset => COLUMNS - 1..COLUMNS,
        }
    }

    /// Effects whose shares span the hypothesis near zero. A payload enters to first order through m, m x, m y and m z.
    pub fn linear_form(self) -> Vec<Effect> {
        match self {
            Self::Payload => [[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [0.0, 0.8, 0.0], [0.0, 0.0, 1.0]]
                .map(|at_m| Effect::Payload(Payload { mass_kg: 250.0, at_m }))
                .to_vec(),
            Self::WheelDrag(wheel) => vec![Effect::WheelDrag(WheelDrag { wheel, torque_n_m: 500.0 })],
            Self::SteeringOffset => vec![Effect::SteeringOffset(SteeringOffset { second: 0.05 })],
        }
    }

    /// Parameters to estimate.
    pub fn free(self) -> &'static [Free] {
        match self {
            Self::Payload => &PAYLOAD,
            Self::WheelDrag(_) => &WHEEL_DRAG,
            Self::SteeringOffset => &STEERING_OFFSET,
        }
    }

    /// The effect with given values of the free parameters.
    pub fn effect(self, values: &[f64]) -> Effect {
        match self {
            Self::Payload => Effect::Payload(Payload { mass_kg: values[0], at_m: [values[1], values[2], values[3]] }),
            Self::WheelDrag(wheel) => Effect::WheelDrag(WheelDrag { wheel, torque_n_m: values[0] }),
            Self::SteeringOffset => Effect::SteeringOffset(SteeringOffset { second: values[0] }),
        }
    }

    /// Where a refit begins: the shares of the linear form as physical parameters.
    pub fn start(self, shares: &[f64]) -> Vec<f64> {
        match self {
            Self::Payload => {
                let (mut mass, mut moment) = (0.0f64, [0.0; 3]);
                for (share, effect) in shares.iter().zip(self.linear_form()) {
                    let Effect::Payload(p) = effect else { continue };
                    mass += share * p.mass_kg;
                    for axis in 0..3 {
                        moment[axis] += share * p.mass_kg * p.at_m[axis];
                    }
                }
                let mass_kg = if mass.abs() < 100.0 { 100f64.copysign(mass) } else { mass };
                let at = |axis: usize, reach: f64| (moment[axis] / mass_kg).clamp(-reach, reach);
                vec![mass_kg, at(0, 2.0), at(1, 0.8), at(2, 1.2)]
            }
            Self::WheelDrag(_) => vec![500.0 * shares[0]],
            Self::SteeringOffset => vec![0.05 * shares[0]],
        }
    }

    /// Moves values into the physical range; true where the range holds one of them.
    pub fn clamp(self, values: &mut [f64]) -> Vec<bool> {
        let parameters = self.effect(values).parameters();
        self.free()
            .iter()
            .zip(values)
            .map(|(f, value)| {
                let [low, high] = parameters[f.parameter].range;
                let margin = 0.01 * (high - low);
                let held = *value <= low + margin || *value >= high - margin;
                *value = value.clamp(low, high);
                held
            })
            .collect()
    }
}
