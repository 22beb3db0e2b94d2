//! How a vehicle rides, and how much lower or more tilted effects make it ride.
//!
//! A network that has learned from a vehicle knows how it rides. A load presses it down and tilts it; asked about that pose, the network speaks of the vehicle
//! that it knows, thrown off its balance, and counters a part of what the load does. It is to be asked about the pose without what the effects make of it.

use crate::driveline::{DrivelineState, command_wheels};
use crate::effects::EffectTerms;
use crate::scalar::Real;
use crate::soil::Soil;
use crate::state::{Control, VehicleState};
use crate::step::{Ground, StepInput, StepModel};
use crate::vehicle::{Vehicle, WHEELS};

/// Speed of the ride as a share of the vehicle's top speed (chosen: the usual speed of the given drives).
const SPEED_SHARE: f64 = 0.2;
/// Duration until the ride has settled, s.
const SETTLED_S: f64 = 4.0;
/// A shift beyond this (m or rad) is none of a ride, but of a vehicle that turns over or sinks out of sight.
const SHIFT_MAX: f64 = 0.5;

/// Height of the reference point over level ground (m), roll and pitch (rad) of a vehicle that goes straight ahead on a soil.
pub type Ride = [f64; 3];

/// How a vehicle rides without any effect on the soil that is usual for it.
#[derive(Clone, Copy, Debug)]
pub struct UsualRide {
    soil: Soil<f64>,
    ride: Ride,
}

impl UsualRide {
    /// Of a vehicle, whatever effects it has, in steps of `dt_s` seconds in `substeps` sub-steps.
    pub fn of(vehicle: &Vehicle, dt_s: f64, substeps: usize, soil: &Soil<f64>) -> Self {
        Self { soil: *soil, ride: ride(vehicle, EffectTerms::default(), dt_s, substeps, soil) }
    }
}

impl StepModel {
    /// The same model, which knows how its effects shift the ride. The usual ride is only asked for where an effect acts on forces or soil.
    pub fn riding_as(mut self, usual: impl FnOnce() -> UsualRide) -> Self {
        let EffectTerms { force, soil, .. } = self.vehicle.effects;
        let acting = EffectTerms { force, soil, ..EffectTerms::default() };
        if acting == EffectTerms::default() {
            return self;
        }
        let usual = usual();
        let shifted = ride(&self.vehicle, acting, self.dt_s, self.substeps, &usual.soil);
        let shift: Ride = core::array::from_fn(|i| shifted[i] - usual.ride[i]);
        if shift.iter().all(|s| s.abs() < SHIFT_MAX) {
            self.ride_shift = shift;
        }
        self
    }

    /// How much higher (m) and more rolled and pitched (rad) the vehicle rides than it would without its effects; zero where the usual soil is not known
    /// ([`StepModel::riding_as`]).
    pub fn ride_shift(&self) -> &Ride {
        &self.ride_shift
    }

    /// A state of the vehicle as it would ride without its effects: what a network that knows the vehicle without them is asked about.
    #[inline(always)]
    pub fn as_known<T: Real>(&self, state: &VehicleState<T>) -> VehicleState<T> {
        let mut known = *state;
        if self.ride_shift != [0.0; 3] {
            let [up_m, roll_rad, pitch_rad] = self.ride_shift.map(T::lit);
            known.position_m[2] = known.position_m[2] - up_m;
            known.attitude_rad[0] = known.attitude_rad[0] - roll_rad;
            known.attitude_rad[1] = known.attitude_rad[1] - pitch_rad;
        }
        known
    }
}

/// The ride of a vehicle with these effects alone on level ground at a fifth of the top speed, after four seconds.
fn ride(vehicle: &Vehicle, effects: EffectTerms, dt_s: f64, substeps: usize, soil: &Soil<f64>) -> Ride {
    let vehicle = &Vehicle { effects, ..vehicle.clone() };
    let model = StepModel::new(vehicle, dt_s, substeps);
    let speed_m_s = SPEED_SHARE * vehicle.command_range[0][1];
    let control = Control { speed_m_s, second: 0.0 };
    let mut state = VehicleState::zero();
    state.position_m[2] = vehicle.standing_height_m();
    state.velocity_m_s[0] = speed_m_s;
    let mut actuators = DrivelineState::settled(&control);
    for _ in 0..(SETTLED_S / dt_s).ceil() as usize {
        let after = actuators.advance(vehicle, &control, state.velocity_m_s[0], dt_s);
        let input = StepInput {
            state,
            wheels: command_wheels(vehicle, &actuators, &after, &control),
            sinkage_log_ratio: [0.0; WHEELS],
            soil: *soil,
            ground: [Ground { height_m: 0.0, slope_ahead: 0.0, slope_left: 0.0 }; WHEELS],
        };
        state = VehicleState::from_array(state.advanced(&model.step(&input).increment.to_array()));
        actuators = after;
    }
    [state.position_m[2], state.attitude_rad[0], state.attitude_rad[1]]
}
