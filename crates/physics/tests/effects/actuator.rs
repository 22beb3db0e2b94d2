//! Goal: commands reach the wheels as each effect says. Method: closed forms of lags, delays and play on the drive line alone.

use nesam_physics::driveline::{DrivelineState, WheelCommand, command_wheels};
use nesam_physics::effects::*;
use nesam_physics::{Control, DT_S, RimServo, SecondCommand, Vehicle, VehicleState};
use nesam_test_vehicles::{robot, torque_truck, truck};

use crate::common::Drive;

/// What the drive line makes of a sequence of commands after a standstill, step by step.
fn follow(vehicle: &Vehicle, commands: &[[f64; 2]]) -> Vec<(DrivelineState, WheelCommand<f64>)> {
    let mut state = DrivelineState::settled(&Control { speed_m_s: 0.0, second: 0.0 });
    let mut out = Vec::new();
    for &[speed_m_s, second] in commands {
        let control = Control { speed_m_s, second };
        let after = state.advance(vehicle, &control, 0.0, DT_S);
        out.push((after, command_wheels(vehicle, &state, &after, &control)));
        state = after;
    }
    out
}

/// A car whose wheels are where they are told to be at once.
fn direct() -> Vehicle {
    let mut vehicle = truck();
    vehicle.second = SecondCommand::RoadWheelAngleRad;
    (vehicle.driveline.steering_lag_s, vehicle.driveline.steering_rate_limit_per_s) = (0.0, 1e3);
    vehicle
}

#[test]
fn analytic_speed_lag_is_exponential() {
    let tau = 0.3;
    let vehicle = truck().with_effects(&[Effect::SpeedLag(SpeedLag { seconds: tau })]);
    for (k, (_, wheels)) in follow(&vehicle, &[[2.0, 0.0]; 12]).iter().enumerate() {
        let decay = |t: f64| (-t / tau).exp();
        let t = k as f64 * DT_S;
        let mean = 2.0 * (1.0 - tau / DT_S * (decay(t) - decay(t + DT_S)));
        assert!((wheels.speed_m_s - mean).abs() < 1e-12, "step {k}: {} {mean}", wheels.speed_m_s);
    }
}

#[test]
fn analytic_speed_delay_shifts_by_fractions_of_a_step() {
    let commands: Vec<[f64; 2]> = (0..12).map(|k| [((k * k) % 7) as f64, 0.0]).collect();
    let sent = |k: i64| if k < 0 { 0.0 } else { commands[k as usize][0] };
    let vehicle = truck().with_effects(&[Effect::SpeedDelay(SpeedDelay { seconds: 0.23 })]);
    for (k, (_, wheels)) in follow(&vehicle, &commands).iter().enumerate() {
        let k = k as i64;
        let want = 0.3 * sent(k - 3) + 0.7 * sent(k - 2);
        assert!((wheels.speed_m_s - want).abs() < 1e-12, "step {k}: {} {want}", wheels.speed_m_s);
    }
}

/// Goal: a dead time of a card and one that an effect brings are one thing, and they add up. Method: a robot under drawn twists, bit by bit.
#[test]
fn analytic_a_dead_time_of_the_card_is_a_delay() {
    let commands: Vec<[f64; 2]> = (0..20).map(|k| [0.1 * f64::from((k * k) % 7), 0.2 * f64::from((k * 3) % 5)]).collect();
    let late = |dead_time_s: [f64; 2], added: [f64; 2]| {
        let mut vehicle = robot();
        vehicle.driveline.rims.dead_time_s = dead_time_s;
        let [speed, steering] = added;
        let effects = [Effect::SpeedDelay(SpeedDelay { seconds: speed }), Effect::SteeringDelay(SteeringDelay { seconds: steering })];
        let run = follow(&vehicle.with_effects(&effects), &commands);
        run.iter().map(|(state, _)| [state.rim_speed_m_s, state.steering].map(f64::to_bits)).collect::<Vec<_>>()
    };
    assert_eq!(late([0.25, 0.5], [0.0; 2]), late([0.0; 2], [0.25, 0.5]));
    assert_eq!(late([0.125, 0.25], [0.125, 0.25]), late([0.0; 2], [0.25, 0.5]));
    assert_ne!(late([0.25, 0.5], [0.0; 2]), late([0.0; 2], [0.0; 2]));
}

#[test]
fn analytic_steering_delay_of_whole_steps_shifts_the_angle() {
    let commands: Vec<[f64; 2]> = (0..12).map(|k| [1.0, 0.02 * ((k * 3) % 5) as f64]).collect();
    let vehicle = direct().with_effects(&[Effect::SteeringDelay(SteeringDelay { seconds: 0.2 })]);
    let (shifted, plain) = (follow(&vehicle, &commands), follow(&direct(), &commands));
    for k in 2..commands.len() {
        assert!((shifted[k].0.steering - plain[k - 2].0.steering).abs() < 1e-12, "step {k}");
    }
}

#[test]
fn analytic_two_steering_lags_in_series() {
    let (own, added) = (0.08, 0.2);
    let mut vehicle = truck().with_effects(&[Effect::SteeringLag(SteeringLag { seconds: added })]);
    vehicle.driveline.steering_lag_s = own;
    vehicle.driveline.steering_rate_limit_per_s = 1e3;
    for (k, (state, _)) in follow(&vehicle, &[[1.0, 0.5]; 10]).iter().enumerate() {
        let t = (k + 1) as f64 * DT_S;
        let want = 0.5 * (1.0 - (added * (-t / added).exp() - own * (-t / own).exp()) / (added - own));
        // A held mean within 10 ms errs in the square of 10 ms over the lags.
        assert!((state.steering - want).abs() < 5e-4, "step {k}: {} {want}", state.steering);
    }
}

#[test]
fn analytic_a_steering_that_is_neither_late_nor_lagged_goes_its_usual_way() {
    // A hundredth of play sends the commands through the altered path, whose pieces of the step must make the same step.
    let play = Effect::SteeringBacklash(SteeringBacklash { second: 1e-9 });
    let commands: Vec<[f64; 2]> = (0..20).map(|k| [1.0 + 0.1 * k as f64, 0.4 * (k as f64 * 0.4).sin()]).collect();
    let (with, without) = (follow(&truck().with_effects(&[play]), &commands), follow(&truck(), &commands));
    for (a, b) in with.iter().zip(&without) {
        assert!((a.0.steering - b.0.steering).abs() < 1e-12);
        assert!((a.0.speed_error_integral_m - b.0.speed_error_integral_m).abs() < 1e-12);
        assert!((a.1.angle_rad[0] - b.1.angle_rad[0]).abs() < 1e-8);
    }
}

#[test]
fn analytic_ratio_and_offset_of_the_road_wheels() {
    let effects = [Effect::SteeringRatio(SteeringRatio { relative: 0.1 }), Effect::SteeringOffset(SteeringOffset { second: 0.02 })];
    let wheels = follow(&direct().with_effects(&effects), &[[1.0, 0.2]; 4])[3].1;
    assert!((wheels.angle_rad[0] - (1.1 * 0.2 + 0.02)).abs() < 1e-12 && wheels.angle_rad[2] == 0.0, "{:?}", wheels.angle_rad);
}

#[test]
fn analytic_an_offset_at_full_lock_turns_the_wheels_beyond_the_table() {
    let mut vehicle = truck();
    (vehicle.driveline.steering_lag_s, vehicle.driveline.steering_rate_limit_per_s) = (0.0, 1e3);
    let table = vehicle.steering.clone().expect("the truck has a steering table");
    let (last, end) = (table.command.len() - 1, 1.0);
    assert_eq!(table.command[last], end);
    let angle = |effects: &[Effect], told: f64| follow(&vehicle.with_effects(effects), &[[1.0, told]; 4])[3].1.angle_rad[0];
    assert!((angle(&[], end) - table.front_left_rad[last]).abs() < 1e-12);
    let slope = (table.front_left_rad[last] - table.front_left_rad[last - 1]) / (table.command[last] - table.command[last - 1]);
    let beyond = angle(&[Effect::SteeringOffset(SteeringOffset { second: 0.12 })], end) - table.front_left_rad[last];
    assert!((beyond / (0.12 * slope) - 1.0).abs() < 1e-9, "{beyond}");
}

#[test]
fn analytic_backlash_is_crossed_at_every_reversal() {
    let play = 0.1;
    let vehicle = direct().with_effects(&[Effect::SteeringBacklash(SteeringBacklash { second: play })]);
    let commands = [[1.0, 0.3], [1.0, 0.3], [1.0, 0.25], [1.0, 0.21], [1.0, 0.1], [1.0, 0.1]];
    let angles: Vec<f64> = follow(&vehicle, &commands).iter().map(|(state, _)| state.road_wheel_angles(&vehicle)[0]).collect();
    for (got, want) in angles.iter().zip([0.25, 0.25, 0.25, 0.25, 0.15, 0.15]) {
        assert!((got - want).abs() < 1e-9, "{angles:?}");
    }
}

#[test]
fn analytic_speed_gain_and_torque_limit_scale_what_the_drive_gets() {
    let gain = Effect::SpeedGain(SpeedGain { relative: 0.05 });
    let limit = Effect::TorqueLimit(TorqueLimit { fraction: 0.4 });
    let wheels = follow(&truck().with_effects(&[gain, limit]), &[[2.0, 0.0]; 3])[2].1;
    assert!((wheels.speed_m_s - 2.1).abs() < 1e-12);
    assert!((wheels.overspeed_limit_m_s / truck().driveline.overspeed_limit_m_s - 0.4).abs() < 1e-12);
}

#[test]
fn property_a_torque_limit_slows_a_climb() {
    let climb = |effects: &[Effect]| {
        let mut drive = Drive::new(truck().with_effects(effects), 2.0);
        drive.slope = [0.12, 0.0];
        (0..60).for_each(|_| {
            drive.step(3.0, 0.0);
        });
        drive.state.velocity_m_s[0]
    };
    let (whole, left) = (climb(&[]), climb(&[Effect::TorqueLimit(TorqueLimit { fraction: 0.3 })]));
    assert!(left < 0.95 * whole, "{left} {whole}");
}

#[test]
fn analytic_track_of_a_differential_drive() {
    let vehicle = robot().with_effects(&[Effect::SkidSteerTrack(SkidSteerTrack { metres: 0.1 })]);
    let (with, without) = (follow(&vehicle, &[[0.5, 1.0]; 30])[29].1, follow(&robot(), &[[0.5, 1.0]; 30])[29].1);
    let difference = |w: &WheelCommand<f64>| w.rim_base_m_s[1] - w.rim_base_m_s[0];
    assert!((difference(&with) / difference(&without) - 0.65 / 0.55).abs() < 1e-12);
}

#[test]
fn analytic_a_lag_begins_at_what_the_rims_do() {
    let tau = 0.3;
    let vehicle = robot().with_effects(&[Effect::SpeedLag(SpeedLag { seconds: tau }), Effect::SpeedGain(SpeedGain { relative: 0.5 })]);
    let decay = |t: f64| (-t / tau).exp();
    let mut state = DrivelineState::turning(&vehicle, [1.0, 0.0]);
    for k in 0..8 {
        state = state.advance(&vehicle, &Control { speed_m_s: 0.0, second: 0.0 }, 0.0, DT_S);
        let t = k as f64 * DT_S;
        let mean = tau / DT_S * (decay(t) - decay(t + DT_S));
        assert!((state.rim_speed_m_s - mean).abs() < 1e-12, "step {k}: {} {mean}", state.rim_speed_m_s);
    }
}

#[test]
fn analytic_play_begins_at_what_the_rims_do() {
    let mut vehicle = robot().with_effects(&[Effect::SteeringBacklash(SteeringBacklash { second: 0.2 })]);
    vehicle.driveline.rims.yaw_gain = 1.5;
    let turning = DrivelineState::turning(&vehicle, [0.5, 0.9]);
    // The command that keeps the rims turning so.
    let held = Control { speed_m_s: 0.5, second: 0.6 };
    let wheels: WheelCommand<f64> = command_wheels(&vehicle, &turning, &turning.advance(&vehicle, &held, 0.5, DT_S), &held);
    let apart = wheels.rim_base_m_s[1] - wheels.rim_base_m_s[0];
    assert!((apart - 0.9 * vehicle.track_m).abs() < 1e-12, "{apart}");
}

#[test]
fn analytic_a_turn_limit_holds_the_rims_and_leaves_slower_turns() {
    let limited = robot().with_effects(&[Effect::TurnLimit(TurnLimit { rad_s: 1.5 })]);
    let turning = |vehicle: &Vehicle, told: f64| follow(vehicle, &[[0.5, told]; 40])[39].0.steering;
    for told in [2.5, -2.5] {
        assert!((turning(&limited, told) - 1.5 * told.signum()).abs() < 1e-9);
    }
    assert_eq!(turning(&limited, 1.2).to_bits(), turning(&robot(), 1.2).to_bits());
}

/// Goal: rims that end at a speed keep the curvature of what they are told, and slower commands are untouched. Method: v - ω B / 2 and v + ω B / 2 by hand.
#[test]
fn analytic_a_wheel_speed_limit_shrinks_both_rims_alike() {
    let limited = robot().with_effects(&[Effect::WheelSpeedLimit(WheelSpeedLimit { m_s: 0.8 })]);
    let settled = |vehicle: &Vehicle, told: [f64; 2]| follow(vehicle, &[told; 60])[59].0.rim_speeds_m_s(vehicle);
    let half = 0.5 * robot().track_m;
    let [left, right] = settled(&limited, [1.0, 1.2]);
    let share = 0.8 / (1.0 + 1.2 * half);
    assert!((right - 0.8).abs() < 1e-6 && (left - share * (1.0 - 1.2 * half)).abs() < 1e-6, "{left} {right}");
    assert_eq!(settled(&limited, [0.3, -0.5]).map(f64::to_bits), settled(&robot(), [0.3, -0.5]).map(f64::to_bits));
}

/// Goal: a base that turns less than its rims begins with rims that turn the faster, and only that changes. Method: a start at a yaw rate that was measured.
#[test]
fn analytic_a_turn_efficiency_tells_the_rims_from_the_motion() {
    let slides = robot().with_effects(&[Effect::TurnEfficiency(TurnEfficiency { factor: 0.4 })]);
    let mut state = VehicleState::from_array([0.0; 12]);
    (state.velocity_m_s[0], state.angular_velocity_rad_s[2]) = (0.5, 0.3);
    let begun = |vehicle: &Vehicle| DrivelineState::<f64>::starting(vehicle, &state, &Control { speed_m_s: 0.5, second: 0.3 });
    assert!((begun(&slides).steering / begun(&robot()).steering - 1.0 / 0.4).abs() < 1e-12);
    assert_eq!(begun(&slides).rim_speed_m_s.to_bits(), begun(&robot()).rim_speed_m_s.to_bits());
    let told =
        |vehicle: &Vehicle| begun(vehicle).advance(vehicle, &Control { speed_m_s: 0.5, second: 0.3 }, 0.5, 20.0).rim_speeds_m_s(vehicle);
    assert!(told(&slides).iter().zip(told(&robot())).all(|(a, b)| (a - b).abs() < 1e-9), "where the rims settle is the same");
}

/// Goal: rims are led to a command by a ramp, and where they are led faster than they would go anyway by nothing. Method: a robot that obeys at once, told another speed and
/// another turning; then a limit that its own lag stays below.
#[test]
fn analytic_acceleration_limits_lead_the_rims_by_a_ramp() {
    let mut direct = robot();
    direct.driveline.rims = RimServo { speed_lag_s: 0.0, yaw_lag_s: 0.0, ..RimServo::default() };
    let (speed, turn) = (AccelerationLimit { m_s2: 2.0 }, TurnAccelerationLimit { rad_s2: 3.0 });
    let limited = direct.with_effects(&[Effect::AccelerationLimit(speed), Effect::TurnAccelerationLimit(turn)]);
    for (k, (state, _)) in follow(&limited, &[[1.5, -1.0]; 10]).into_iter().enumerate() {
        let passed_s = DT_S * (k + 1) as f64;
        assert!((state.rim_speed_m_s - (2.0 * passed_s).min(1.5)).abs() < 1e-12, "step {k}: {}", state.rim_speed_m_s);
        assert!((state.steering + (3.0 * passed_s).min(1.0)).abs() < 1e-12, "step {k}: {}", state.steering);
    }
    let mut lagged = robot();
    lagged.driveline.rims = RimServo { speed_lag_s: 0.5, yaw_lag_s: 0.5, ..RimServo::default() };
    let loose = lagged.with_effects(&[Effect::AccelerationLimit(AccelerationLimit { m_s2: 3.0 })]);
    let speeds =
        |vehicle: &Vehicle| follow(vehicle, &[[1.5, 0.0]; 10]).into_iter().map(|(state, _)| state.rim_speed_m_s).collect::<Vec<_>>();
    for (a, b) in speeds(&loose).into_iter().zip(speeds(&lagged)) {
        assert!((a - b).abs() < 1e-12, "{a} {b}");
    }
}

#[test]
fn analytic_compliance_is_a_smaller_angle() {
    let compliance = 8e-6;
    let turn = |effects: &[Effect], command: &dyn Fn(&Drive) -> f64| {
        let mut drive = Drive::new(truck().with_effects(effects), 3.0);
        (0..80).for_each(|_| {
            let second = command(&drive);
            drive.step(3.0, second);
        });
        drive.state.angular_velocity_rad_s[2]
    };
    let compliant = turn(&[Effect::SteeringCompliance(SteeringCompliance { rad_n: compliance })], &|_| 0.6);
    // The same vehicle told to take back C F_y itself: F_y = M (l_r / L) v ω.
    let on_front = 2493.56 * 1.7028 / (1.5949 + 1.7028);
    let told = turn(&[], &|d| 0.6 - compliance * on_front * d.state.velocity_m_s[0] * d.state.angular_velocity_rad_s[2] / 0.37);
    let plain = turn(&[], &|_| 0.6);
    assert!((compliant / told - 1.0).abs() < 0.01 && compliant < 0.99 * plain, "{compliant} {told} {plain}");
}

#[test]
fn analytic_a_lock_spreads_the_slips_of_an_axle() {
    let lock = [Effect::LockedDifferential(LockedDifferential { share: 1.0 })];
    let turn = |effects: &[Effect]| {
        let mut drive = Drive::new(truck().with_effects(effects), 2.0);
        let mut contacts = None;
        (0..60).for_each(|_| contacts = Some(drive.step(2.0, 0.7).contacts));
        let contacts = contacts.unwrap();
        (drive.state, contacts[2].slip - contacts[3].slip)
    };
    let (open, apart) = turn(&[]);
    let (locked, spread) = turn(&lock);
    // Rims turn alike, so inner and outer slip differ by ω times the track over the speed.
    let want = locked.angular_velocity_rad_s[2] * 1.82 / locked.velocity_m_s[0];
    assert!(((spread - apart) / want - 1.0).abs() < 0.25, "{spread} {apart} {want}");
    assert!(locked.angular_velocity_rad_s[2] < open.angular_velocity_rad_s[2], "a lock resists the turn");
}

/// Goal: an actuator that becomes late, lagged or loose in the middle of a drive begins with what it was last told, not with the first command of the history. Method: a
/// history that begins otherwise and then holds one command; from then on the effect, or none: the same wheels. And under commands that go on changing: those of
/// an effect that was there before, once its memory has passed.
#[test]
fn regress_an_onset_replays_no_old_commands() {
    let effects = [
        Effect::SpeedLag(SpeedLag { seconds: 1.0 }),
        Effect::SpeedDelay(SpeedDelay { seconds: 0.45 }),
        Effect::SteeringLag(SteeringLag { seconds: 0.5 }),
        Effect::SteeringDelay(SteeringDelay { seconds: 0.5 }),
        Effect::SteeringBacklash(SteeringBacklash { second: 0.2 }),
    ];
    let wheels = |before: &Vehicle, after: &Vehicle, commands: &[[f64; 2]], onset: usize| -> Vec<WheelCommand<f64>> {
        let mut state = DrivelineState::settled(&Control { speed_m_s: 0.0, second: 1.0 });
        let step = |(k, &[speed_m_s, second]): (usize, &[f64; 2])| {
            let (vehicle, control) = (if k < onset { before } else { after }, Control { speed_m_s, second });
            let next = state.advance(vehicle, &control, 1.5, DT_S);
            let told = command_wheels(vehicle, &state, &next, &control);
            state = next;
            told
        };
        commands.iter().enumerate().map(step).collect()
    };
    let same = |a: &WheelCommand<f64>, b: &WheelCommand<f64>, says: &str| {
        let of = |w: &WheelCommand<f64>| [w.angle_rad, w.rim_base_m_s, [w.speed_m_s; 4]].concat();
        of(a).iter().zip(of(b)).for_each(|(a, b)| assert!((a - b).abs() < 1e-12, "{says}: {a} {b}"));
    };
    let held = [vec![[0.0, 1.0]; 3], vec![[2.0, 0.25]; 160]].concat();
    let changing: Vec<[f64; 2]> = (0..160).map(|k| [2.0 + (k as f64 * 0.3).sin(), 0.4 * (k as f64 * 0.2).cos()]).collect();
    for plain in [truck(), robot()] {
        for effect in effects {
            let (altered, says) = (plain.with_effects(&[effect]), format!("{} on {}", effect.id(), plain.name));
            let [with, without] = [&altered, &plain].map(|after| wheels(&plain, after, &held, 150));
            with[150..].iter().zip(&without[150..]).for_each(|(a, b)| same(a, b, &says));
            // A lag, unlike a delay, begins where it is told to be.
            if matches!(effect, Effect::SpeedDelay(_) | Effect::SteeringDelay(_)) {
                let [late, always] = [(&plain, 20), (&altered, 0)].map(|(before, onset)| wheels(before, &altered, &changing, onset));
                same(&late[150], &always[150], &says);
                let mean = |w: &WheelCommand<f64>| w.speed_m_s;
                assert!((20..25).all(|k| (mean(&late[k]) - mean(&always[k])).abs() < 1e-12), "{says}");
            }
        }
    }
}

/// Goal: a skid-steer base whose steering is off begins with rims that turn as its motion tells. Method: the rims at the start against yaw rate over efficiency, and the
/// command that keeps them.
#[test]
fn regress_an_offset_and_a_ratio_count_once_where_a_drive_begins() {
    let mut vehicle = robot();
    vehicle.driveline.rims.turn_efficiency = 0.5;
    let effects = [Effect::SteeringOffset(SteeringOffset { second: 0.3 }), Effect::SteeringRatio(SteeringRatio { relative: 0.5 })];
    let vehicle = vehicle.with_effects(&effects);
    let mut state = VehicleState::zero();
    state.angular_velocity_rad_s[2] = 0.4;
    let told = Control { speed_m_s: 0.0, second: (0.4 / 0.5 - 0.3) / 1.5 };
    let begun = DrivelineState::<f64>::starting(&vehicle, &state, &told);
    for actuators in [begun, begun.advance(&vehicle, &told, 0.0, DT_S)] {
        let [left, right] = actuators.rim_speeds_m_s(&vehicle);
        assert!(((right - left) / vehicle.track_m - 0.4 / 0.5).abs() < 1e-12, "{left} {right}");
    }
}

/// Goal: what a car under torque holds against the usual resistance is asked for by the command that arrives, not by the one that is sent. Method: a command that is taken
/// back, late or lagged; what the integral's observer takes off is the same.
#[test]
fn regress_a_late_command_is_held_until_another_one_arrives() {
    let sound = torque_truck();
    let holding_m_s = sound.driveline.torque.expect("a torque drives this car").holding_demand_m_s;
    let commands = [[2.0, 0.0]; 12].into_iter().chain([[0.0, 0.0]; 4]).collect::<Vec<_>>();
    let base = |vehicle: &Vehicle| -> Vec<f64> {
        let integral_m = |state: &DrivelineState| vehicle.driveline.speed_integral_gain_per_s * state.speed_error_integral_m;
        let mut before = DrivelineState::settled(&Control { speed_m_s: 0.0, second: 0.0 });
        let held = |(state, wheels): &(DrivelineState, WheelCommand<f64>)| {
            let held = wheels.rim_base_m_s[0] - integral_m(&before);
            before = *state;
            held
        };
        follow(vehicle, &commands).iter().map(held).collect()
    };
    let late = base(&sound.with_effects(&[Effect::SpeedDelay(SpeedDelay { seconds: 0.3 })]));
    let now = base(&sound);
    assert!((now[11] - holding_m_s).abs() < 1e-3 && now[12].abs() < 1e-9, "{now:?}");
    assert!(late[12..15].iter().all(|held| (held - now[11]).abs() < 1e-9) && late[15].abs() < 1e-9, "{late:?}");
    let lagged = base(&sound.with_effects(&[Effect::SpeedLag(SpeedLag { seconds: 1.0 })]));
    assert!(lagged[12] > 0.9 * holding_m_s, "{lagged:?}");
}

/// Goal: the longest dead time of a card and the longest delay of an effect act together at steps of 0.1 s, and the longest delay at half of that; what is longer is
/// refused. Method: when a command gets to the actuator.
#[test]
fn regress_long_delays_are_followed_or_refused() {
    let delay = [Effect::SteeringDelay(SteeringDelay { seconds: 0.6 })];
    let arrives_s = |vehicle: &Vehicle, dt_s: f64| {
        let mut state = DrivelineState::settled(&Control { speed_m_s: 1.0, second: 0.0 });
        let begins = (0..60).position(|_| {
            state = state.advance(vehicle, &Control { speed_m_s: 1.0, second: 0.5 }, 1.0, dt_s);
            state.steering > 1e-9
        });
        begins.map(|k| k as f64 * dt_s)
    };
    assert!((arrives_s(&truck().with_effects(&delay), 0.05).unwrap() - 0.6).abs() < 1e-9);
    let mut late = truck();
    late.driveline.rims.dead_time_s = [0.6; 2];
    assert!((arrives_s(&late.with_effects(&delay), 0.1).unwrap() - 1.2).abs() < 1e-9);
    let scheduled = delay.map(ScheduledEffect::from);
    late.check_effects(&scheduled, 0.1).unwrap();
    late.check_effects(&[], 0.05).unwrap();
    let error = late.check_effects(&scheduled, 0.05).unwrap_err();
    assert!(error.contains("1.2 s late (by `steering_delay`)") && error.contains("0.6"), "{error}");
}
