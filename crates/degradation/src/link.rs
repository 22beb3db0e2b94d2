//! The messages of a drive as they arrive.

use nesam_engine::{Measurement, WheelMeasurement};
use nesam_physics::{Control, VehicleState, wrap_angle};
use nesam_trajectories::Trajectory;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, Exp1, StandardNormal};

use crate::Degradation;

/// A message that arrives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arrival {
    /// When it arrives, s after the beginning of the drive.
    pub arrival_s: f64,
    /// When its state was true, s after the beginning of the drive.
    pub true_s: f64,
    /// What it says.
    pub measurement: Measurement,
}

/// What came over the link.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// Messages in their order of arrival.
    pub arrivals: Vec<Arrival>,
    /// Messages that were sent.
    pub sent: usize,
}

/// Streams of random numbers: one for each thing that can be wrong, so that switching one off leaves the others as they are.
#[derive(Clone, Copy)]
enum Stream {
    Loss,
    Jitter,
    Reorder,
    Stamp,
    Bias,
    Noise,
}

/// Seed and drive as one number (FNV-1a), so that drives are degraded each in its own way, in whatever order they come.
fn random(seed: u64, drive: &str, stream: Stream) -> ChaCha8Rng {
    let bytes = seed.to_le_bytes().into_iter().chain(drive.bytes()).chain([stream as u8]);
    ChaCha8Rng::seed_from_u64(bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)))
}

/// State, command and wheels at one time of a drive.
struct Sample {
    time_s: f64,
    state: VehicleState<f64>,
    command: Control<f64>,
    wheels: WheelMeasurement,
}

/// The messages of a drive; the same for the same drive, degradation and seed.
pub fn degraded(drive: &Trajectory, spec: &Degradation, seed: u64) -> Link {
    let mut samples = samples(drive, spec.imu_hz);
    spoil(&mut samples, drive, spec, seed);
    let stream = |which| random(seed, &drive.id, which);
    let (mut loss, mut jitter, mut reorder, mut stamps) =
        (stream(Stream::Loss), stream(Stream::Jitter), stream(Stream::Reorder), stream(Stream::Stamp));
    let end_s = samples.last().map_or(0.0, |sample| sample.time_s);
    let sent = samples.len();
    let interval_s = if sent > 1 { end_s / (sent - 1) as f64 } else { drive.dt_s };
    let mut arrivals = Vec::with_capacity(sent);
    for (index, sample) in samples.into_iter().enumerate() {
        // Every stream gives one number for each message, lost or not.
        let lost = loss.random_range(0.0..1.0) < spec.loss;
        let late: f64 = Exp1.sample(&mut jitter);
        let overtaken = reorder.random_range(0.0..1.0) < spec.reorder;
        let off: f64 = StandardNormal.sample(&mut stamps);
        if lost {
            continue;
        }
        let middle = (end_s / 3.0..end_s * 2.0 / 3.0).contains(&sample.time_s);
        let clock_s = if middle { spec.clock_step_s } else { 0.0 };
        let held_s = if overtaken { 1.5 * interval_s } else { 0.0 };
        let stamp_s = sample.time_s + clock_s + spec.stamp_s * off;
        arrivals.push(Arrival {
            arrival_s: sample.time_s + spec.jitter_s * late + held_s,
            true_s: sample.time_s,
            measurement: Measurement {
                sequence: Some(index as u64 + 1),
                boot: None,
                stamp_ns: (stamp_s * 1e9).round() as i64,
                state: sample.state,
                command: sample.command,
                wheels: sample.wheels,
            },
        });
    }
    arrivals.sort_by(|a, b| a.arrival_s.total_cmp(&b.arrival_s));
    Link { arrivals, sent }
}

/// The samples of a drive, or those at another rate: poses and velocities interpolated linearly, angles along the shorter way, commands held.
fn samples(drive: &Trajectory, rate_hz: f64) -> Vec<Sample> {
    let count = drive.states.len();
    if count == 0 {
        return Vec::new();
    }
    if rate_hz <= 0.0 {
        return (0..count).map(|i| sample_at(drive, i as f64 * drive.dt_s)).collect();
    }
    let end_s = (count - 1) as f64 * drive.dt_s;
    let many = (end_s * rate_hz + 1e-6).floor() as usize + 1;
    (0..many).map(|i| sample_at(drive, i as f64 / rate_hz)).collect()
}

fn sample_at(drive: &Trajectory, time_s: f64) -> Sample {
    let (at, share) = place(drive, time_s);
    let next = (at + 1).min(drive.states.len() - 1);
    let speed = drive.wheel_speed_rad_s.as_ref().map(|w| core::array::from_fn(|i| w[at][i] + share * (w[next][i] - w[at][i])));
    let angle = drive.road_wheel_angle_rad.as_ref().map(|a| core::array::from_fn(|i| a[at][i] + share * (a[next][i] - a[at][i])));
    Sample {
        time_s,
        state: blend(&drive.states[at], &drive.states[next], share),
        command: drive.controls[at],
        wheels: WheelMeasurement { speed_rad_s: speed, road_wheel_angle_rad: angle },
    }
}

/// Sample at or before a time, and the share of the next one. A time within a microstep of a sample is the sample.
pub(crate) fn place(drive: &Trajectory, time_s: f64) -> (usize, f64) {
    let last = drive.states.len() - 1;
    let position = (time_s / drive.dt_s).clamp(0.0, last as f64);
    let nearest = position.round();
    if (position - nearest).abs() < 1e-6 {
        return (nearest as usize, 0.0);
    }
    (position.floor() as usize, position.fract())
}

/// The state between two.
pub(crate) fn blend(a: &VehicleState<f64>, b: &VehicleState<f64>, share: f64) -> VehicleState<f64> {
    if share == 0.0 {
        return *a;
    }
    let (from, to) = (a.to_array(), b.to_array());
    VehicleState::from_array(core::array::from_fn(|i| match i {
        3..6 => wrap_angle(from[i] + share * wrap_angle(to[i] - from[i])),
        _ => from[i] + share * (to[i] - from[i]),
    }))
}

/// Adds bias and coloured noise to velocities and angular velocities.
fn spoil(samples: &mut [Sample], drive: &Trajectory, spec: &Degradation, seed: u64) {
    let sd = [spec.velocity_noise_m_s, spec.gyro_noise_rad_s];
    let bias_sd = [spec.velocity_bias_m_s, spec.gyro_bias_rad_s];
    let (mut biases, mut noises) = (random(seed, &drive.id, Stream::Bias), random(seed, &drive.id, Stream::Noise));
    let bias: [f64; 6] = core::array::from_fn(|axis| bias_sd[axis / 3] * unit(&mut biases));
    let mut noise: [f64; 6] = core::array::from_fn(|axis| sd[axis / 3] * unit(&mut noises));
    let mut before_s = samples.first().map_or(0.0, |sample| sample.time_s);
    for sample in samples {
        // A first-order Gauss-Markov process at the times of the samples: it keeps its standard deviation at every rate.
        let kept = if spec.noise_time_s > 0.0 { (-(sample.time_s - before_s) / spec.noise_time_s).exp() } else { 0.0 };
        before_s = sample.time_s;
        for axis in 0..6 {
            noise[axis] = kept * noise[axis] + (1.0 - kept * kept).sqrt() * sd[axis / 3] * unit(&mut noises);
            let value = match axis {
                0..3 => &mut sample.state.velocity_m_s[axis],
                _ => &mut sample.state.angular_velocity_rad_s[axis - 3],
            };
            *value += bias[axis] + noise[axis];
        }
    }
}

fn unit(random: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(random)
}

#[cfg(test)]
mod tests {
    use nesam_trajectories::MeasuredChannels;

    use super::*;

    /// A straight drive at 2 m/s, 10 Hz.
    fn drive(count: usize) -> Trajectory {
        let state = |i: usize| {
            let mut state = VehicleState::zero();
            state.position_m[0] = 0.2 * i as f64;
            state.velocity_m_s[0] = 2.0;
            state.attitude_rad[2] = wrap_angle(0.04 * i as f64);
            state
        };
        Trajectory {
            id: "d".into(),
            set: "s".into(),
            world: None,
            split: None,
            dt_s: 0.1,
            time_s: (0..count).map(|i| 0.1 * i as f64).collect(),
            states: (0..count).map(state).collect(),
            controls: (0..count).map(|i| Control { speed_m_s: i as f64, second: 0.0 }).collect(),
            wheel_speed_rad_s: None,
            road_wheel_angle_rad: None,
            measured: MeasuredChannels::POSE_AND_TWIST,
            truth: None,
        }
    }

    fn spec(text: &str) -> Degradation {
        Degradation::parse(text).unwrap()
    }

    #[test]
    fn analytic_a_clean_link_gives_the_drive() {
        let drive = drive(50);
        let link = degraded(&drive, &Degradation::default(), 1);
        assert_eq!((link.sent, link.arrivals.len()), (50, 50));
        for (i, arrival) in link.arrivals.iter().enumerate() {
            let m = &arrival.measurement;
            assert_eq!((m.state, m.command, m.sequence), (drive.states[i], drive.controls[i], Some(i as u64 + 1)));
            assert_eq!((m.stamp_ns, arrival.arrival_s), (i as i64 * 100_000_000, arrival.true_s));
        }
    }

    #[test]
    fn property_the_same_seed_gives_the_same_messages() {
        let (drive, all) = (drive(100), spec("all"));
        assert_eq!(degraded(&drive, &all, 7), degraded(&drive, &all, 7));
        assert_ne!(degraded(&drive, &all, 7), degraded(&drive, &all, 8));
        let other = Trajectory { id: "e".into(), ..drive.clone() };
        assert_ne!(degraded(&other, &all, 7).arrivals, degraded(&drive, &all, 7).arrivals);
        // Loss alone loses the same messages as loss among everything else.
        let kept = |text: &str| {
            degraded(&drive, &spec(text), 3).arrivals.iter().map(|a| a.measurement.sequence).collect::<std::collections::BTreeSet<_>>()
        };
        assert_eq!(kept("loss=0.3"), kept("loss=0.3,jitter,reorder,stamp,clock-step"));
    }

    #[test]
    fn analytic_loss_jitter_and_order_have_their_statistics() {
        let drive = drive(20_001);
        let lost = degraded(&drive, &spec("loss=0.05"), 1);
        // Binomial: sd of the share is sqrt(0.05 0.95 / 20001) = 0.0015; four of them.
        let share = 1.0 - lost.arrivals.len() as f64 / lost.sent as f64;
        assert!((share - 0.05).abs() < 0.0062, "{share}");
        // Exponential: the standard deviation is the mean. Standard errors at 20001 values: 0.7 % and 1.4 % of it.
        let delays: Vec<f64> = degraded(&drive, &spec("jitter=10ms"), 1).arrivals.iter().map(|a| a.arrival_s - a.true_s).collect();
        let mean = delays.iter().sum::<f64>() / delays.len() as f64;
        let sd = (delays.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / delays.len() as f64).sqrt();
        assert!((mean / 0.01 - 1.0).abs() < 0.03 && (sd / 0.01 - 1.0).abs() < 0.06, "{mean} {sd}");
        // A held message lets exactly the next one pass, unless that is held too: probability p (1 - p).
        let order: Vec<u64> = degraded(&drive, &spec("reorder=0.1"), 1).arrivals.iter().filter_map(|a| a.measurement.sequence).collect();
        let turned = order.windows(2).filter(|pair| pair[1] < pair[0]).count() as f64 / order.len() as f64;
        assert!((turned - 0.09).abs() < 0.01, "{turned}");
    }

    #[test]
    fn analytic_the_clock_steps_there_and_back() {
        let link = degraded(&drive(301), &spec("clock-step=0.5s"), 1);
        for arrival in &link.arrivals {
            let off_s = arrival.measurement.stamp_ns as f64 * 1e-9 - arrival.true_s;
            let expected = if (10.0..20.0).contains(&arrival.true_s) { 0.5 } else { 0.0 };
            assert!((off_s - expected).abs() < 1e-8, "{} s: {off_s}", arrival.true_s);
        }
    }

    #[test]
    fn analytic_coloured_noise_has_its_deviation_and_memory() {
        let drive = drive(20_001);
        let link = degraded(&drive, &spec("imu=50hz,gyro-bias=0,velocity-bias=0,gyro-noise=0.1,noise-time=0.5s"), 1);
        assert_eq!(link.sent, 100_001);
        let noise: Vec<f64> = link.arrivals.iter().map(|a| a.measurement.state.angular_velocity_rad_s[2]).collect();
        let product = |lag: usize| noise.iter().zip(&noise[lag..]).map(|(a, b)| a * b).sum::<f64>() / (noise.len() - lag) as f64;
        // 2000 s of a process with a memory of 0.5 s: 2000 independent stretches, so the variance is known to about 3 %.
        assert!((product(0).sqrt() / 0.1 - 1.0).abs() < 0.08, "{}", product(0).sqrt());
        let correlation = product(25) / product(0);
        assert!((correlation - (-1.0f64).exp()).abs() < 0.1, "{correlation}");
        // Between the samples of the drive, poses are on the line between them and the command is the one before.
        let between = &link.arrivals[7];
        assert!((between.measurement.state.position_m[0] - 0.28).abs() < 1e-9 && between.measurement.command.speed_m_s == 1.0);
        assert_eq!(link.arrivals[5].measurement.state.position_m, drive.states[1].position_m);
    }

    #[test]
    fn analytic_a_bias_stays_the_same_along_a_drive() {
        let clean = drive(30);
        let link = degraded(&clean, &spec("gyro-bias=0.01"), 4);
        let bias = |i: usize| link.arrivals[i].measurement.state.angular_velocity_rad_s;
        assert!(bias(0).iter().all(|b| *b != 0.0 && b.abs() < 0.05));
        assert!((1..30).all(|i| bias(i) == bias(0)));
    }
}
