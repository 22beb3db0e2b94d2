use nesam_physics::{Control, SecondCommand, VehicleState};

use super::*;
use nesam_trajectories::{MeasuredChannels, VelocitySource};

/// The wheels of the car lie that far to the left, m.
const LEFT_M: [f64; 4] = [0.9176, -0.9176, 0.91, -0.91];

/// The reference point of the car lies that far ahead of its rear axle, m.
const AHEAD_M: f64 = 1.5;

/// A car on a wavy plane that drives curves, in the conventions of the data root.
pub(super) fn sound() -> Trajectory {
    let (dt_s, wheelbase_m) = (0.1, 3.3);
    // Of the rear axle.
    let (mut x, mut y, mut yaw) = (0.0_f64, 0.0_f64, 0.3_f64);
    let (mut states, mut controls, mut wheels, mut angles) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for k in 0..400 {
        let t = f64::from(k) * dt_s;
        let (speed, angle) = (2.0 + 0.8 * (0.7 * t).sin(), 0.3 * (0.15 * t).sin());
        let slope = 0.15 * (0.3 * x).cos() * yaw.cos();
        let yaw_rate = speed / wheelbase_m * angle.tan();
        states.push(VehicleState {
            position_m: [x + AHEAD_M * yaw.cos(), y + AHEAD_M * yaw.sin(), 0.5 * (0.3 * x).sin()],
            attitude_rad: [0.02 * (1.3 * t).sin(), -slope.atan(), wrap_angle(yaw)],
            velocity_m_s: [speed / slope.atan().cos(), AHEAD_M * yaw_rate, 0.0],
            angular_velocity_rad_s: [0.026 * (1.3 * t).cos(), 0.0, yaw_rate],
        });
        controls.push(Control { speed_m_s: speed, second: angle });
        angles.push([angle; 2]);
        wheels.push(LEFT_M.map(|left_m| (speed - left_m * yaw_rate) / 0.4));
        (x, y, yaw) = (x + dt_s * speed * yaw.cos(), y + dt_s * speed * yaw.sin(), yaw + dt_s * yaw_rate);
    }
    let measured = MeasuredChannels {
        angular_velocity: [true, false, true],
        wheel_speed: true,
        road_wheel_angle: true,
        ..MeasuredChannels::POSE_AND_TWIST
    };
    Trajectory {
        id: "a".into(),
        set: "s".into(),
        world: None,
        split: None,
        dt_s,
        time_s: (0..400).map(|k| f64::from(k) * dt_s).collect(),
        states,
        controls,
        wheel_speed_rad_s: Some(wheels),
        road_wheel_angle_rad: Some(angles),
        measured,
        truth: None,
    }
}

pub(super) fn car() -> Vehicle {
    let mut car = nesam_test_vehicles::truck();
    (car.second, car.wheelbase_m, car.wheel_radius_m) = (SecondCommand::RoadWheelAngleRad, 3.3, 0.4);
    for (wheel, centre) in car.wheel_centre_m.iter_mut().enumerate() {
        centre[0] = if wheel < 2 { 3.3 - AHEAD_M } else { -AHEAD_M };
    }
    car
}

pub(super) fn told(change: impl Fn(&mut Trajectory)) -> String {
    let mut drive = sound();
    change(&mut drive);
    doubts(&[drive], &car()).iter().map(|d| format!("{}; {}\n", d.what, d.advice)).collect()
}

pub(super) fn states(change: impl Fn(&mut VehicleState<f64>)) -> impl Fn(&mut Trajectory) {
    move |drive| drive.states.iter_mut().for_each(&change)
}

#[test]
fn analytic_a_sound_drive_raises_no_doubt() {
    assert_eq!(told(|_| {}), "");
}

/// A generator of numbers from 0 to 1 (Knuth's multiplier, high bits).
pub(super) fn numbers(mut seed: u64) -> impl FnMut() -> f64 {
    move || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (seed >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// Goal: a velocity that has nothing to do with the positions is doubted. Method: noise about zero, noise with the mean of the true speed, a constant (seed 5).
#[test]
fn analytic_velocities_that_are_unrelated_to_positions_are_doubted() {
    let noise = |mean: f64, spread: f64| {
        told(move |drive| {
            let mut next = numbers(5);
            drive.states.iter_mut().for_each(|s| s.velocity_m_s[0] = mean + spread * (next() - 0.5));
        })
    };
    for told in [noise(0.0, 8.0), noise(2.0, 4.0), noise(2.0, 0.0)] {
        assert!(told.contains("forward velocity") && told.contains("from which column"), "{told}");
    }
}

/// Goal: positions that stop while the rest moves, and positions that jump, are doubted with where and how much; what a sound localisation does is not.
/// Method: 6 s of standing positions, 0.8 s of them, a jump of 10 m and one of 0.8 m in 0.1 s.
#[test]
fn analytic_frozen_and_jumping_positions_are_doubted() {
    let frozen = |samples: usize| {
        told(move |drive| {
            let there = drive.states[100].position_m;
            drive.states[100..100 + samples].iter_mut().for_each(|s| s.position_m = there);
        })
    };
    let jump = |way_m: f64| told(move |drive| drive.states[200..].iter_mut().for_each(|s| s.position_m[0] += way_m));
    let said = frozen(60);
    assert!(said.contains("frozen in 1 of 1 drives: in `a` for 6.0 s from 10.0 s on") && said.lines().count() == 1, "{said}");
    let said = jump(10.0);
    assert!(said.contains("jump 1 times: in `a` by 9.7 m") && said.contains("at 20.0 s") && said.lines().count() == 1, "{said}");
    assert_eq!(frozen(8) + &jump(0.8), "");
}

/// Goal: positions that jump back and forth are told however often they do, and nothing else of them. Method: every tenth position zero, and every second one of another
/// place; a path in millimetres, which the velocities tell; the same with nothing that tells a speed.
#[test]
fn regress_positions_that_jump_often_are_told() {
    let every = |nth: usize, x_m: f64| {
        told(move |drive| drive.states.iter_mut().step_by(nth).for_each(|s| s.position_m = [x_m, x_m, s.position_m[2]]))
    };
    for (told, times) in [(every(10, -9999.0), 79), (every(2, 500.0), 399)] {
        let expected = format!("positions jump back and forth, {times} times: in `a`");
        assert!(told.contains(&expected) && told.contains("leave such cells empty") && told.lines().count() == 1, "{expected}: {told}");
    }
    let in_mm = |drive: &mut Trajectory| drive.states.iter_mut().for_each(|s| s.position_m = s.position_m.map(|v| 1e3 * v));
    let told_in_mm = told(in_mm);
    assert!(told_in_mm.contains("forward velocity against positions") && !told_in_mm.contains("jump"), "{told_in_mm}");
    let nothing_else = told(|drive| {
        in_mm(drive);
        drive.measured.velocity_source = VelocitySource::Positions;
        (drive.wheel_speed_rad_s, drive.road_wheel_angle_rad) = (None, None);
        drive.states.iter_mut().for_each(|s| s.velocity_m_s = [0.0; 3]);
        drive.controls.iter_mut().for_each(|c| *c = Control { speed_m_s: 0.0, second: 0.0 });
    });
    assert!(!nothing_else.is_empty(), "something is told");
}

/// Goal: a heading that jumps is told. Method: half a turn for 5 s of 40, and a quarter of a turn without a gyro; a heading that is held for 0.9 s and catches up is sound.
#[test]
fn regress_headings_that_jump_are_told() {
    let turned = |by_rad: f64, gyro: bool| {
        told(move |drive| {
            drive.measured.angular_velocity[2] = gyro;
            drive.states[200..250].iter_mut().for_each(|s| s.attitude_rad[2] = wrap_angle(s.attitude_rad[2] + by_rad));
        })
    };
    for (told, degrees) in [(turned(std::f64::consts::PI, true), "180"), (turned(-1.6, false), "9")] {
        let expected = format!("the heading jumps 2 times: in `a` by {degrees}");
        assert!(told.contains(&expected) && told.contains("course over ground") && told.lines().count() == 1, "{expected}: {told}");
    }
    let held = told(|drive| {
        let held = drive.states[100].attitude_rad;
        drive.states[100..109].iter_mut().for_each(|s| s.attitude_rad = held);
    });
    assert_eq!(held, "");
}

/// Goal: quaternions w, x, y, z that were read as x, y, z, w are called so. Method: the attitudes of the sound drive through both orders.
#[test]
fn regress_quaternions_in_another_order_are_named() {
    let told = told(states(|s| {
        let [(sr, cr), (sp, cp), (sy, cy)] = s.attitude_rad.map(|angle| (0.5 * angle).sin_cos());
        let [x, y, z, w] =
            [sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy];
        s.attitude_rad = nesam_physics::vec3::attitude_of_quaternion([w, x, y, z]).unwrap();
    }));
    assert!(told.contains("seem to hold w, x, y, z") && told.contains("--column qw=qx") && told.lines().count() == 1, "{told}");
}

/// Goal: positions in degrees of latitude and longitude are called so, whatever else is measured. Method: the sound drive at 50 degrees of latitude with its
/// velocities, with its wheels alone, with its commands alone.
#[test]
fn analytic_positions_in_degrees_are_named() {
    let degrees = |drive: &mut Trajectory| {
        for s in &mut drive.states {
            s.position_m = [11.0 + s.position_m[0] / 71_700.0, 50.0 + s.position_m[1] / 111_300.0, s.position_m[2]];
        }
    };
    let unmeasured = |drive: &mut Trajectory| {
        degrees(drive);
        drive.measured.velocity_source = VelocitySource::Positions;
        drive.states.iter_mut().for_each(|s| s.velocity_m_s = [0.0; 3]);
    };
    let commands_alone = |drive: &mut Trajectory| {
        unmeasured(drive);
        drive.wheel_speed_rad_s = None;
    };
    for told in [told(degrees), told(unmeasured), told(commands_alone)] {
        assert!(told.contains("degrees of latitude and longitude"), "{told}");
    }
}

/// Goal: a single wheel with a wrong sign or unit is named, and so are swapped sides. Method: each mistake in the sound drive, which turns both ways.
#[test]
fn analytic_single_wheels_and_swapped_sides_are_named() {
    let wheels = |change: fn([f64; 4]) -> [f64; 4]| {
        told(move |drive| drive.wheel_speed_rad_s.iter_mut().flatten().for_each(|wheels| *wheels = change(*wheels)))
    };
    let mistakes: [(&[&str], String); 5] = [
        (&["rim speed of RL", "-0.99", "wheels counted backwards"], wheels(|[fl, fr, rl, rr]| [fl, fr, -rl, rr])),
        (&["rim speed of FR", "9.7", "revolutions per minute"], wheels(|[fl, fr, rl, rr]| [fl, 9.55 * fr, rl, rr])),
        (&["rim speed of FR", "nothing moved"], wheels(|[fl, _, rl, rr]| [fl, 0.0, rl, rr])),
        (&["the left and right wheels turn against the yaw"], wheels(|[fl, fr, rl, rr]| [fr, fl, rr, rl])),
        (&["the rear left and right wheels turn against the yaw"], wheels(|[fl, fr, rl, rr]| [fl, fr, rr, rl])),
    ];
    for (expected, told) in mistakes {
        assert!(expected.iter().all(|part| told.contains(part)) && told.lines().count() == 1, "{expected:?} is not all of\n{told}");
    }
}

/// Goal: road-wheel angles in another unit or with another sign are named, of one wheel too; a wrong command or a wrong motion is no wrong angle. Method: each mistake
/// in the sound drive, which steers both ways; lost angles, an offset and a ratio within what faults make.
#[test]
fn analytic_road_wheel_angles_that_fit_neither_command_nor_motion_are_named() {
    let angles = |change: fn([f64; 2]) -> [f64; 2]| {
        told(move |drive| drive.road_wheel_angle_rad.iter_mut().flatten().for_each(|angles| *angles = change(*angles)))
    };
    let mistakes: [(&[&str], String); 6] = [
        (&["road-wheel angle against the steering command: 57.29", "degrees instead of radians"], angles(|a| a.map(f64::to_degrees))),
        (&["road-wheel angle against", "0.017", "taken for degrees"], angles(|a| a.map(f64::to_radians))),
        (&["road-wheel angle against", "-1.0", "angles to the left are positive"], angles(|a| a.map(|a| -a))),
        (&["road-wheel angle against", "-57.29", "to the left are positive", "degrees"], angles(|a| a.map(|a| -a.to_degrees()))),
        (&["road-wheel angle of FL", "-1.0"], angles(|[left, right]| [-left, right])),
        (&["road-wheel angle of FR", "degrees"], angles(|[left, right]| [left, right.to_degrees()])),
    ];
    for (expected, told) in mistakes {
        assert!(expected.iter().all(|part| told.contains(part)) && told.lines().count() == 1, "{expected:?} is not all of\n{told}");
    }
    assert_eq!(angles(|[left, right]| [1.2 * left + 0.05, 0.8 * right + 0.05]), "");
    assert_eq!(told(|drive| drive.road_wheel_angle_rad = None), "");
    for told in
        [told(|drive| drive.controls.iter_mut().for_each(|c| c.second *= -1.0)), told(states(|s| s.angular_velocity_rad_s[2] *= 57.3))]
    {
        assert!(!told.is_empty() && !told.contains("road-wheel angle"), "{told}");
    }
}

/// Goal: a doubt names the cause. Method: commands in km/h; time stamps in ms, which make every rate a thousand times the change; wheel speeds in m/s and in
/// turns per second, on wheels on which they are alike and on others.
#[test]
fn analytic_units_are_told_of_the_channel_that_has_them() {
    let commanded = told(|drive| drive.controls.iter_mut().for_each(|c| c.speed_m_s *= 3.6));
    assert!(commanded.contains("speed command: 0.27") && commanded.contains("a speed command in km/h"), "{commanded}");
    let clock = told(|drive| drive.dt_s *= 1e3);
    let rates: Vec<&str> = clock.lines().filter(|line| line.contains("times as much")).collect();
    assert!(rates.len() >= 3 && rates.iter().all(|line| line.contains("have time stamps in milliseconds")), "{clock}");
    let wheels = |radius_m: f64, per_m_s: f64| {
        let vehicle = Vehicle { wheel_radius_m: radius_m, ..car() };
        let mut drive = sound();
        drive.wheel_speed_rad_s.iter_mut().flatten().for_each(|wheels| *wheels = wheels.map(|w| 0.4 * w * per_m_s));
        doubts(&[drive], &vehicle).iter().map(|d| format!("{}; {}\n", d.what, d.advice)).collect::<String>()
    };
    let turns = |radius_m: f64| 1.0 / (std::f64::consts::TAU * radius_m);
    assert_eq!(wheels(0.4, 1.0 / 0.4), "");
    for (told, has, lacks) in
        [(wheels(0.4, 1.0), "metres per second", "revolutions"), (wheels(0.4, turns(0.4)), "revolutions per second", "metres per second")]
    {
        assert!(told.contains(has) && !told.contains(lacks), "{told}");
    }
    for told in [wheels(0.165, 1.0), wheels(0.165, turns(0.165))] {
        assert!(told.contains("revolutions per second") && told.contains("or else metres per second"), "{told}");
    }
}

/// Goal: of a log of PX4 that was imported as one of ROS the frame is told. Method: y to the right, z down and yaw clockwise from north, steering to the right too.
#[test]
fn analytic_a_mirrored_log_is_told_of_the_frame() {
    let told = told(|drive| {
        for s in &mut drive.states {
            let ([x, y, z], [vx, vy, vz], [wx, wy, wz], [roll, pitch, yaw]) =
                (s.position_m, s.velocity_m_s, s.angular_velocity_rad_s, s.attitude_rad);
            s.position_m = [y, x, -z];
            (s.velocity_m_s, s.angular_velocity_rad_s) = ([vx, -vy, -vz], [wx, -wy, -wz]);
            s.attitude_rad = [roll, -pitch, wrap_angle(std::f64::consts::FRAC_PI_2 - yaw)];
        }
        drive.controls.iter_mut().for_each(|c| c.second *= -1.0);
        drive.road_wheel_angle_rad.iter_mut().flatten().for_each(|angles| *angles = angles.map(|a| -a));
    });
    assert!(told.contains("swap their columns") && told.contains("--frame ned-frd") && told.lines().count() == 1, "{told}");
}

/// Goal: a few short drives, some with a pose that freezes and catches up, are sound; a wrong unit in them is told all the same. Method: sets of 1 to 12 drives
/// of 2 s cut out of the sound one, of which a fourth freezes for 0.9 s, as the Husky's do (seeds 1 to 40).
#[test]
fn property_few_short_drives_with_freezing_poses_raise_no_doubt() {
    let set = |seed: u64, drives: usize| -> Vec<Trajectory> {
        let mut next = numbers(seed);
        let cut = |i: usize| {
            let (mut drive, begin) = (sound(), (next() * 380.0) as usize);
            drive.time_s = drive.time_s[..20].to_vec();
            drive.states = drive.states[begin..begin + 20].to_vec();
            drive.controls = drive.controls[begin..begin + 20].to_vec();
            drive.wheel_speed_rad_s = drive.wheel_speed_rad_s.map(|wheels| wheels[begin..begin + 20].to_vec());
            drive.road_wheel_angle_rad = drive.road_wheel_angle_rad.map(|angles| angles[begin..begin + 20].to_vec());
            if i.is_multiple_of(4) {
                let held = drive.states[6];
                for s in &mut drive.states[6..15] {
                    (s.position_m, s.attitude_rad) = (held.position_m, held.attitude_rad);
                }
            }
            drive
        };
        (0..drives).map(cut).collect()
    };
    for seed in 1..=40 {
        for drives in 1..=12 {
            let mut some = set(seed, drives);
            assert_eq!(doubts(&some, &car()), [], "{drives} drives, seed {seed}");
            some.iter_mut().flat_map(|drive| &mut drive.states).for_each(|s| s.velocity_m_s[0] *= 3.6);
            let told = doubts(&some, &car());
            assert!(drives < 6 || told.iter().any(|doubt| doubt.advice.contains("km/h")), "{drives} drives, seed {seed}: {told:?}");
        }
    }
}

/// Goal: a gyro is held against angles that are measured, not against the zeros of those that are not. Method: a base that rolls and pitches at up to 0.2 rad/s, with
/// the angles that follow from it, then with zeros for them: doubted where these are said to be measured, and sound where they are not.
#[test]
fn regress_a_gyro_is_not_held_against_angles_that_nobody_measured() {
    let shaken = |angles: f64, measured: bool| {
        told(|drive| {
            for (k, s) in drive.states.iter_mut().enumerate() {
                let phase = 0.13 * k as f64;
                for axis in [0, 1] {
                    (s.attitude_rad[axis], s.angular_velocity_rad_s[axis]) = (angles * 0.2 / 1.3 * phase.sin(), 0.2 * phase.cos());
                }
                (s.position_m[2], s.velocity_m_s[2]) = (0.0, 0.0);
            }
            drive.measured.angular_velocity = [true; 3];
            drive.measured.height = measured;
            drive.measured.attitude = [measured, measured, true];
        })
    };
    assert_eq!(shaken(1.0, true), "");
    let zeros = shaken(0.0, true);
    assert!(zeros.contains("roll rate against the change of roll") && zeros.contains("pitch rate"), "{zeros}");
    assert_eq!(shaken(0.0, false), "");
}

#[test]
fn analytic_every_mistake_is_named() {
    let mistakes: [(&str, String); 11] = [
        ("km/h", told(states(|s| s.velocity_m_s[0] *= 3.6))),
        ("pointing to the rear", told(states(|s| s.velocity_m_s[0] *= -1.0))),
        ("degrees instead of radians", told(states(|s| s.angular_velocity_rad_s[2] *= 57.3))),
        ("clockwise", told(states(|s| s.attitude_rad[2] = wrap_angle(std::f64::consts::FRAC_PI_2 - s.attitude_rad[2])))),
        ("from north", told(states(|s| s.attitude_rad[2] = wrap_angle(s.attitude_rad[2] - std::f64::consts::FRAC_PI_2)))),
        ("nose points down", told(states(|s| s.attitude_rad[1] *= -1.0))),
        ("degrees instead of radians", told(states(|s| s.attitude_rad[1] = 30.0 * (2.0 + s.attitude_rad[1])))),
        ("opposite sign: steering to the left", told(|drive| drive.controls.iter_mut().for_each(|c| c.second *= -1.0))),
        ("speed command: -1.0", told(|drive| drive.controls.iter_mut().for_each(|c| c.speed_m_s *= -1.0))),
        ("km/h", told(|drive| drive.controls.iter_mut().for_each(|c| c.speed_m_s /= 3.6))),
        ("rim speed", told(|drive| drive.wheel_speed_rad_s.iter_mut().flatten().for_each(|w| *w = w.map(|w| 9.55 * w)))),
    ];
    for (i, (expected, told)) in mistakes.iter().enumerate() {
        assert!(told.contains(expected), "{i}: `{expected}` is not in\n{told}");
    }
}

#[test]
fn analytic_a_card_of_wrong_units_is_doubted() {
    assert!(card_doubts(&nesam_test_vehicles::truck(), None).is_empty());
    let said = |change: fn(&mut Vehicle)| {
        let mut card = nesam_test_vehicles::truck();
        change(&mut card);
        card_doubts(&card, None).into_iter().map(|doubt| doubt.what).collect::<Vec<_>>()
    };
    for (change, what) in [
        ((|card| card.gravity_m_s2 = 1.62) as fn(&mut Vehicle), "gravity is 1.620 m/s²"),
        (|card| card.wheel_centre_m.iter_mut().for_each(|wheel| wheel[2] += 1.5), "height of the centre of gravity"),
        (|card| card.wheel_centre_m.iter_mut().for_each(|wheel| wheel[1] *= 5.0), "the track is 9.138 m"),
        (|card| card.wheel_centre_m.iter_mut().for_each(|wheel| wheel[1] *= 0.2), "the track over the wheelbase is 0.111"),
        (|card| card.suspension_n_m = [5.0; 4], "the deflection of the springs under the weight is 1223"),
        (|card| card.driveline.steering_lag_s = 300.0, "the lag of the steering is 300.000 s"),
        (
            |card| (card.mass_kg, card.suspension_n_m) = (7.5, card.suspension_n_m.map(|rate| 0.003 * rate)),
            "the mass is 7.500 kg, vehicles on wheels of 0.467 m in radius have 50.9 to",
        ),
        (
            |card| card.steering.iter_mut().for_each(|table| table.front_left_rad.iter_mut().for_each(|a| *a *= 57.3)),
            "the largest road-wheel angle is",
        ),
        (
            |card| (card.second, card.command_range[1]) = (SecondCommand::RoadWheelAngleRad, [-30.0, 30.0]),
            "the largest road-wheel angle of the range of commands is 30.000 rad",
        ),
        (|card| card.inertia_kg_m2[2][2] = 4.0 * card.inertia_kg_m2[1][1], "no body has the moments of inertia"),
    ] {
        let said = said(change);
        assert!(said.len() == 1 && said[0].contains(what), "{said:?}");
    }
}

/// Goal: a whole that weighs less than its parts is doubted, and rounding is not. Method: parts of a third less, of as much, of 0.05 % and of 1 % more than the mass.
#[test]
fn regress_a_mass_below_that_of_its_parts_is_doubted() {
    let truck = nesam_test_vehicles::truck();
    for (share, doubted) in [(0.67, false), (1.0, false), (1.0005, false), (1.01, true)] {
        let found = card_doubts(&truck, Some(share * truck.mass_kg));
        assert_eq!(
            found.iter().filter(|doubt| doubt.what.contains("chassis and wheels alone weigh")).count(),
            usize::from(doubted),
            "{share}"
        );
        assert_eq!(found.len(), usize::from(doubted), "{found:?}");
    }
}

/// Goal: positions of another point than the reference point of the card are told with where it is; what turns about a point between its axles is not. Method: the sound
/// drive as it is measured at its rear axle, and 2 m ahead; a heading that is 3 degrees wrong; a drive that turns to the left alone; the same as a skid-steer base, which
/// turns about its rear axle, and 2 m behind.
#[test]
fn analytic_positions_of_another_point_are_told() {
    let at = |ahead_m: f64| states(move |s| *s = s.at_point([ahead_m, 0.0, 0.0]));
    let rear = told(at(-AHEAD_M));
    assert!(rear.contains("of the rear axle") && rear.contains(" m larger than it was") && rear.lines().count() == 1, "{rear}");
    let ahead = told(at(2.0));
    assert!(ahead.contains(" m ahead of the reference point") && ahead.contains("smaller") && ahead.lines().count() == 1, "{ahead}");
    // The path is made of steps along the heading at their beginning, which is half a step of turning behind that of the path: 0.1 m at 2 m/s.
    for (told, before, expected_m) in [(&rear, "X,Y,Z` that is ", 1.5), (&ahead, "of a point ", 2.0)] {
        let size_m: f64 = told.split(before).nth(1).and_then(|rest| rest.split(' ').next()?.parse().ok()).unwrap();
        assert!((size_m - expected_m).abs() < 0.15, "{told}");
    }
    assert_eq!(told(states(|s| s.attitude_rad[2] = wrap_angle(s.attitude_rad[2] + 0.05))), "");
    let to_the_left = |drive: &mut Trajectory| {
        at(-AHEAD_M)(drive);
        let straight = drive.states.iter().position(|s| s.angular_velocity_rad_s[2] < 0.0).unwrap();
        drive.states.truncate(straight);
    };
    assert_eq!(told(to_the_left), "");
    let base = Vehicle { second: SecondCommand::YawRateRadS, ..car() };
    let turning = |ahead_m: f64| {
        let mut drive = sound();
        at(ahead_m)(&mut drive);
        for (control, state) in drive.controls.iter_mut().zip(&drive.states) {
            control.second = state.angular_velocity_rad_s[2];
        }
        doubts(&[drive], &base)
    };
    assert_eq!(turning(-AHEAD_M), []);
    let behind = turning(-AHEAD_M - 2.0);
    assert!(behind.len() == 1 && behind[0].what.contains(" m behind the reference point"), "{behind:?}");
}

/// Goal: channels of another clock are told, and what a vehicle takes to answer is not. Method: the sound drive with positions, the heading, both, and commands that come later
/// or earlier; commands that are followed after 0.6 s.
#[test]
fn analytic_channels_of_another_clock_are_told() {
    /// Values from `by` samples before; the first or last one where there is none.
    fn shifted<T: Copy>(values: &mut [T], by: isize) {
        let old = values.to_vec();
        let last = old.len() - 1;
        values.iter_mut().enumerate().for_each(|(k, value)| *value = old[k.saturating_add_signed(-by).min(last)]);
    }
    let poses = |by: isize, position: bool, attitude: bool| {
        told(move |drive| {
            let mut poses: Vec<_> = drive.states.iter().map(|s| (s.position_m, s.attitude_rad)).collect();
            shifted(&mut poses, by);
            for (s, (position_m, attitude_rad)) in drive.states.iter_mut().zip(poses) {
                s.position_m = if position { position_m } else { s.position_m };
                s.attitude_rad = if attitude { attitude_rad } else { s.attitude_rad };
            }
        })
    };
    let commands = |by: isize| told(move |drive| shifted(&mut drive.controls, by));
    for (expected, told) in [
        // 1.2 s, and the half step by which the path is behind already.
        ("positions come 1.3 s after velocities", poses(12, true, false)),
        ("the speed comes 1.2 s before the speed command", commands(12)),
        ("the speed comes 1.8 s after the speed command", commands(-18)),
    ] {
        assert!(told.contains(expected) && told.contains("of two clocks"), "`{expected}` is not in\n{told}");
    }
    assert_eq!(commands(-6), "");
}
