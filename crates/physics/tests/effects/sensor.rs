//! Goal: measured states differ from true ones as each sensor effect says, and the way back is exact. Method: closed forms of rigid motion, rotations of
//! another library.

use nalgebra::Rotation3;
use nesam_physics::VehicleState;
use nesam_physics::effects::*;

use crate::force::in_free_space;

/// A state in a tilted turn.
fn moving() -> VehicleState<f64> {
    VehicleState::from_array([3.0, -4.0, 1.5, 0.12, -0.2, 2.3, 3.0, 0.2, -0.1, 0.05, -0.08, 0.4])
}

fn terms(effects: &[Effect]) -> SensorTerms {
    let mut terms = EffectTerms::default();
    effects.iter().for_each(|e| e.add_to(&mut terms));
    terms.sensor
}

#[test]
fn property_the_way_back_is_the_inverse() {
    let all: Vec<Effect> = Effect::examples().into_iter().filter(|e| e.layer() == Layer::Sensor).collect();
    for sensors in all.iter().map(|e| terms(&[*e])).chain([terms(&all)]) {
        let back = sensors.to_true(&sensors.to_measured(&moving())).to_array();
        for (got, want) in back.iter().zip(moving().to_array()) {
            assert!((got - want).abs() < 1e-12, "{sensors:?}: {back:?}");
        }
    }
}

#[test]
fn analytic_gyro_bias_and_scale_and_velocity_scale() {
    let sensors = terms(&[
        Effect::GyroBias(GyroBias { rad_s: 0.01 }),
        Effect::GyroScale(GyroScale { relative: 0.05 }),
        Effect::VelocityScale(VelocityScale { relative: -0.02 }),
    ]);
    let (x, y) = (moving(), sensors.to_measured(&moving()));
    assert!((y.angular_velocity_rad_s[2] - (1.05 * 0.4 + 0.01)).abs() < 1e-12);
    assert!((y.angular_velocity_rad_s[0] - 1.05 * 0.05).abs() < 1e-12);
    assert!((y.velocity_m_s[0] - 0.98 * 3.0).abs() < 1e-12);
    assert_eq!((x.position_m, x.attitude_rad), (y.position_m, y.attitude_rad));
    let at_rest = sensors.to_measured(&VehicleState::<f64>::zero());
    assert!((at_rest.angular_velocity_rad_s[2] - 0.01).abs() < 1e-15, "a turn at rest");
}

#[test]
fn analytic_latency_is_the_place_on_the_circle_before() {
    let (speed, rate, latency) = (3.0f64, 0.5, 0.2);
    let at = |t: f64| {
        let yaw = rate * t;
        let place = [speed / rate * yaw.sin(), speed / rate * (1.0 - yaw.cos()), 0.0];
        VehicleState {
            position_m: place,
            attitude_rad: [0.0, 0.0, yaw],
            velocity_m_s: [speed, 0.0, 0.0],
            angular_velocity_rad_s: [0.0, 0.0, rate],
        }
    };
    let place = terms(&[Effect::PositionLatency(PositionLatency { seconds: latency })]).to_measured(&at(4.0));
    let pose = terms(&[Effect::PoseLatency(PoseLatency { seconds: latency })]).to_measured(&at(4.0));
    for seen in [place, pose] {
        for (got, want) in seen.position_m.iter().zip(at(4.0 - latency).position_m) {
            assert!((got - want).abs() < 1e-3, "{:?}", seen.position_m);
        }
        assert_eq!(seen.angular_velocity_rad_s, at(4.0).angular_velocity_rad_s);
    }
    assert_eq!(place.attitude_rad, at(4.0).attitude_rad);
    assert!((pose.attitude_rad[2] - at(4.0 - latency).attitude_rad[2]).abs() < 1e-12, "{:?}", pose.attitude_rad);
}

#[test]
fn analytic_a_series_tells_the_way_within_a_latency() {
    // Speeds up and turns ever faster: x' = v cos ψ with v = 1 + a t, ψ = c t²; places by Simpson's rule on a fine grid.
    let (a, c, dt) = (1.5f64, 0.1, 0.1);
    let velocity = |t: f64| [(1.0 + a * t) * (c * t * t).cos(), (1.0 + a * t) * (c * t * t).sin()];
    let place = |t: f64| {
        let (n, mut sum) = (2000, [0.0; 3]);
        for i in 0..=n {
            let weight = if i == 0 || i == n {
                1.0
            } else if i % 2 == 1 {
                4.0
            } else {
                2.0
            };
            let v = velocity(t * i as f64 / n as f64);
            (sum[0], sum[1]) = (sum[0] + weight * v[0] * t / n as f64 / 3.0, sum[1] + weight * v[1] * t / n as f64 / 3.0);
        }
        sum
    };
    let at = |t: f64, pose_of: f64| VehicleState {
        position_m: place(pose_of),
        attitude_rad: [0.0, 0.0, c * t * t],
        velocity_m_s: [1.0 + a * t, 0.0, 0.0],
        angular_velocity_rad_s: [0.0, 0.0, 2.0 * c * t],
    };
    let series = |latency: f64, pose: bool| -> Vec<_> {
        let of = |k: usize| {
            let t = k as f64 * dt;
            let mut state = at(t, t - latency);
            if pose {
                state.attitude_rad[2] = c * (t - latency).powi(2);
            }
            state
        };
        (0..40).map(of).collect()
    };
    for latency in [0.35, 0.1, 0.02, -0.15] {
        let position = terms(&[Effect::PositionLatency(PositionLatency { seconds: latency })]);
        let pose = terms(&[Effect::PoseLatency(PoseLatency { seconds: latency })]);
        for (sensors, measured) in [(position, series(latency, false)), (pose, series(latency, true))] {
            let truth = sensors.to_true_along(&measured, dt);
            for (k, state) in truth.iter().enumerate().skip(5).take(30) {
                let t = k as f64 * dt;
                let off = (0..3).map(|i| (state.position_m[i] - place(t)[i]).abs()).fold(0.0, f64::max);
                assert!(off < 2e-3, "{latency} s, sample {k}: {off} m");
                assert!((state.attitude_rad[2] - c * t * t).abs() < 1e-3, "{latency} s, sample {k}: {:?}", state.attitude_rad);
            }
        }
    }
    let late = terms(&[Effect::PositionLatency(PositionLatency { seconds: 0.35 })]);
    let mut measured = series(0.35, false);
    let present = |k: usize| (late.to_true(&measured[k]).position_m[0] - place(k as f64 * dt)[0]).abs();
    assert!(present(20) > 0.05, "the present velocity alone would do: {} m", present(20));
    // A sample that is not there spoils itself and no other; the first has nobody before it.
    let whole = late.to_true_along(&measured, dt);
    measured[18].velocity_m_s[0] = f64::NAN;
    let holed = late.to_true_along(&measured, dt);
    assert!(holed.iter().enumerate().all(|(k, s)| k == 18 || s.position_m[0].is_finite()));
    assert_eq!((holed[17], holed[23]), (whole[17], whole[23]));
    assert!((whole[0].position_m[0] - late.to_true(&measured[0]).position_m[0]).abs() < 1e-12);
}

#[test]
fn analytic_a_lever_arm_moves_with_the_body() {
    let sensors = terms(&[Effect::LeverArm(LeverArm { x_m: 0.5, y_m: -0.2 })]);
    let x = moving();
    let seen = sensors.to_measured(&x);
    let [roll, pitch, yaw] = x.attitude_rad;
    let arm = Rotation3::from_euler_angles(roll, pitch, yaw) * nalgebra::Vector3::new(0.5, -0.2, 0.0);
    for axis in 0..3 {
        assert!((seen.position_m[axis] - x.position_m[axis] - arm[axis]).abs() < 1e-12);
    }
    // ω × ℓ about z: (-ω_z ℓ_y, ω_z ℓ_x).
    assert!((seen.velocity_m_s[0] - x.velocity_m_s[0] - 0.4 * 0.2).abs() < 1e-12);
    assert!((seen.velocity_m_s[1] - x.velocity_m_s[1] - 0.4 * 0.5).abs() < 1e-12);
}

#[test]
fn analytic_a_mount_angle_turns_attitude_and_velocities() {
    let sensors = terms(&[Effect::MountAngle(MountAngle { roll_rad: 0.03, pitch_rad: -0.05, yaw_rad: 0.08 })]);
    let x = moving();
    let seen = sensors.to_measured(&x);
    let rotation = |a: [f64; 3]| Rotation3::from_euler_angles(a[0], a[1], a[2]);
    let mount = rotation([0.03, -0.05, 0.08]);
    let want = rotation(x.attitude_rad) * mount;
    assert!(rotation(seen.attitude_rad).angle_to(&want) < 1e-12, "{:?}", seen.attitude_rad);
    let velocity = mount.inverse() * nalgebra::Vector3::from(x.velocity_m_s);
    for axis in 0..3 {
        assert!((seen.velocity_m_s[axis] - velocity[axis]).abs() < 1e-12);
    }
}

#[test]
fn analytic_a_fast_clock_makes_steps_shorter() {
    let far = |effects: &[Effect]| in_free_space(effects, 2.0).position_m[0];
    let ratio = far(&[Effect::ClockDrift(ClockDrift { relative: 0.04 })]) / far(&[]);
    assert!((ratio * 1.04 - 1.0).abs() < 1e-9, "{ratio}");
}
