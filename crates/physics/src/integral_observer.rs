//! What a measured motion says of the integral of the speed control.
//!
//! A controller with an integral part has long made up for a slope, a soft soil or a dragging brake when a prediction begins; a history of a few seconds
//! does not tell how far, if the integral is rebuilt from speed errors alone. The motion tells: whatever force moved the vehicle, its drive was asked for.

use crate::driveline::{DrivelineState, limited, unlimited};
use crate::scalar::Real;
use crate::soil::Soil;
use crate::state::{Control, VehicleState};
use crate::step::StepModel;
use crate::terramechanics::Support;
use crate::torque_drive::Grip;
use crate::vec3::Tilt;
use crate::vehicle::{Vehicle, WHEELS, told_backwards};

/// Speeds between which a motion comes to say something of the drive, m/s (chosen: below them a climb per way is noise).
const MOVING_M_S: [f64; 2] = [0.15, 0.45];
/// Share of the largest demand up to which a torque says what was demanded (chosen: beyond it the limit hides it).
const UNSATURATED: f64 = 0.9;
/// Integral gain below which the integral says nothing, 1/s.
const SMALLEST_GAIN_PER_S: f64 = 0.02;
/// Power of the weight with which compaction resists: (2 n + 2) / (2 n + 1) of a rigid wheel (Bekker 1969; Wong, *Theory of Ground Vehicles*, ch. 2), for the
/// n = 0.7 of a sandy loam (Wong's table); 1.35 to 1.5 over all but the stiffest of its soils.
const COMPACTION_POWER: f64 = 1.42;
/// Smallest share of its torque that an engine is taken to give where its integral is told.
const SMALLEST_SHARE: f64 = 0.05;

/// Share to which a speed ahead, m/s, is a motion that says something of the drive: 0 at rest, 1 when driving, smooth between.
fn moving<T: Real>(speed_m_s: T) -> T {
    let [rests, moves] = MOVING_M_S;
    let share = ((speed_m_s - T::lit(rests)) * T::lit(1.0 / (moves - rests))).max(T::lit(0.0)).min(T::lit(1.0));
    share.sqr() * (T::lit(3.0) - share * T::lit(2.0))
}

/// What the integral of the speed error, m, amounts to beyond what holds the usual resistance of a sound car under torque that goes at a speed and is told another one, m/s:
/// all of it is missing in a car that stands, a weak engine asks for more. It points where the car is told to go, ahead where it is told to stand. 0 where there is
/// no torque or no integral.
pub(crate) fn held_by_integral_m<T: Real<Value = f64>>(vehicle: &Vehicle, speed_m_s: T, told_m_s: T) -> T {
    let line = &vehicle.driveline;
    let Some(torque) = line.torque.as_ref().filter(|_| line.speed_integral_gain_per_s >= SMALLEST_GAIN_PER_S) else { return T::lit(0.0) };
    let share = (1.0 - vehicle.effects.actuator.torque_lost).max(SMALLEST_SHARE);
    let more = moving(T::select_ge0(speed_m_s, speed_m_s, -speed_m_s)) * T::lit(1.0 / share) - T::lit(1.0);
    let direction = T::lit(1.0) - T::lit(2.0) * told_backwards(told_m_s);
    let limit = T::lit(line.speed_integral_limit_m);
    (more * direction * T::lit(torque.holding_demand_m_s / line.speed_integral_gain_per_s)).max(-limit).min(limit)
}

impl StepModel {
    /// Actuators after a measured step from `before` to `after`, of which `advanced` is what commands and speeds made: the integral of the speed error is
    /// drawn towards the one that explains the motion, at the card's rate. Unchanged for a vehicle whose hubs no torque drives, and at rest.
    ///
    /// The force along the way, m (Δv/Δt + g Δz / (v Δt)) with what effects hold against it, asks for a torque beyond the usual resistance (that of the
    /// held demand, for a heavier vehicle as compaction grows with the weight); the inverse of the torque's law gives the demand, less the part of the
    /// present error: the integral's.
    pub fn observed_actuators(
        &self,
        advanced: &DrivelineState,
        control: &Control<f64>,
        before: &VehicleState<f64>,
        after: &VehicleState<f64>,
        dt_s: f64,
    ) -> DrivelineState {
        let line = &self.vehicle().driveline;
        let Some(torque) = line.torque.as_ref().filter(|t| t.integral_observer_per_s > 0.0) else { return *advanced };
        let [speed_before, speed_after] = [before, after].map(|s| s.velocity_m_s[0]);
        let speed = 0.5 * (speed_before + speed_after);
        if speed <= MOVING_M_S[0] || line.speed_integral_gain_per_s < SMALLEST_GAIN_PER_S {
            return *advanced;
        }
        let climb = (after.position_m[2] - before.position_m[2]) / (speed * dt_s);
        let acceleration = (speed_after - speed_before) / dt_s + self.vehicle().gravity_m_s2 * climb;
        let force_n = self.body.mass_kg * acceleration + self.lasting_resistance_n(before, speed);
        let share = 1.0 - self.vehicle().effects.actuator.torque_lost;
        let limit = line.overspeed_limit_m_s;
        let heavier = (self.body.mass_kg / self.vehicle().mass_kg).powf(COMPACTION_POWER);
        // The ground resists a weak engine as it does a sound one.
        let usual = torque.torques(limited(torque.holding_demand_m_s, limit), speed, speed, 1.0);
        let usual_n_m = (usual.driving_n_m - usual.braking_n_m) * heavier;
        let Some(brought) = torque.demand_m_s(usual_n_m + force_n * self.vehicle().wheel_radius_m, speed, share) else { return *advanced };
        let demand = unlimited(brought.clamp(-UNSATURATED * limit, UNSATURATED * limit), limit);
        let told = advanced.told_speed_m_s(self.vehicle(), control);
        let integral = (demand - torque.held_m_s(told) - line.speed_gain * (told - speed)) / line.speed_integral_gain_per_s;
        let integral = integral.clamp(-line.speed_integral_limit_m, line.speed_integral_limit_m);
        let rate = (torque.integral_observer_per_s * dt_s).min(1.0) * moving(speed);
        let kept = advanced.speed_error_integral_m;
        DrivelineState { speed_error_integral_m: kept + rate * (integral - kept), ..*advanced }
    }

    /// The share of a lasting resistance that an integral has been drawn to after so many observed steps.
    pub fn observed_share(&self, steps: usize) -> f64 {
        let torque = self.vehicle().driveline.torque.as_ref();
        torque.map_or(0.0, |torque| 1.0 - (1.0 - torque.integral_observer_per_s * self.dt_s()).clamp(0.0, 1.0).powi(steps as i32))
    }

    /// What the integral of the speed error, m, has been drawn to beyond [`StepModel::observed_actuators`] where the ground is not the `prior` soil, whose compaction is
    /// in the usual resistance, but another one: the demand that compaction asks for on the one less that on the other, over the gain. `share` of it is
    /// told by the history ([`StepModel::observed_share`]). Without it a softer soil predicts a slowing that the speed control made up for long ago.
    ///
    /// Compaction is that of four wheels which carry the weight alike at the sinkage of a [`Grip`]. Fades out towards rest; zero where no torque drives the hubs.
    pub fn compaction_made_up_for_m<T: Real<Value = f64>>(&self, prior: &Soil<f64>, soil: &Soil<T>, speed_m_s: T, share: f64) -> T {
        let line = &self.vehicle().driveline;
        let driven = line.torque.as_ref().filter(|_| share > 0.0 && line.speed_integral_gain_per_s >= SMALLEST_GAIN_PER_S);
        let Some(torque) = driven.filter(|_| speed_m_s.value() > MOVING_M_S[0]) else { return T::lit(0.0) };
        let usual_n = if self.wheel.is_damped() {
            self.compaction_n(&Soil::from_array(prior.to_array().map(T::lit)), speed_m_s)
        } else {
            T::lit(self.compaction_n(prior, speed_m_s.value()))
        };
        let force_n = self.compaction_n(soil, speed_m_s) - usual_n;
        let engine = 1.0 - self.vehicle().effects.actuator.torque_lost;
        let demand = force_n * T::lit(self.vehicle().wheel_radius_m) / torque.driving_n_m_s_m(speed_m_s, engine);
        let limit = UNSATURATED * line.overspeed_limit_m_s;
        demand.max(T::lit(-limit)).min(T::lit(limit)) * moving(speed_m_s) * T::lit(share / line.speed_integral_gain_per_s)
    }

    /// Force at the rims that compaction takes of four wheels which carry the weight alike, N; it depends on the speed where the soil is damped, under the
    /// leading axle.
    fn compaction_n<T: Real>(&self, soil: &Soil<T>, speed_m_s: T) -> T {
        let load_n = T::lit(self.body.mass_kg * self.vehicle().gravity_m_s2 / WHEELS as f64);
        let weight = Support { preload_n: load_n, rate_n_m: T::lit(0.0) };
        let of_axle = |pressing_m_s: T| Grip::settled(&self.wheel, &weight, pressing_m_s, soil).compaction_n * T::lit(2.0);
        let following = of_axle(T::lit(0.0));
        following + if self.wheel.is_damped() { of_axle(speed_m_s) } else { following }
    }

    /// What effects hold against a vehicle that goes straight ahead on level ground at a speed (m/s) above rest, N.
    fn lasting_resistance_n(&self, state: &VehicleState<f64>, speed_m_s: f64) -> f64 {
        let terms = &self.vehicle().effects.force;
        let of_wheels = terms.rolling_resistance * self.body.mass_kg * self.vehicle().gravity_m_s2
            + terms.wheel_drag_n_m.iter().sum::<f64>() / self.vehicle().wheel_radius_m;
        let mut on_body = [0.0; 6];
        if self.altered.on_body {
            let straight = VehicleState { velocity_m_s: [speed_m_s, 0.0, 0.0], ..VehicleState::zero() };
            self.add_body_forces_at(&straight, state.attitude_rad[2], [0.0; 3], &Tilt::new(0.0, 0.0), &mut on_body);
        }
        of_wheels - on_body[0]
    }
}
