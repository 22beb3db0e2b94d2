//! Goal: the watch alarms on what it is for, stays silent otherwise, dates the onset, and tells each episode once.

use super::*;

const SECOND_NS: i64 = 1_000_000_000;

/// Pseudo-random numbers with mean 0 and variance 1, uniform, the same for the same seed; and the errors of the sensors where the last buffer ended.
struct Noise(u64, [f64; CONTRADICTIONS]);

impl Noise {
    fn of(seed: u64) -> Self {
        Self(seed, [0.0; CONTRADICTIONS])
    }

    /// Sensors against each other: the errors of positions and attitudes at both ends, one of which the buffer before shares.
    fn contradiction(&mut self) -> [f64; CONTRADICTIONS] {
        let before = self.1;
        self.1 = core::array::from_fn(|c| SENSOR_ENDS_SD[c] * core::f64::consts::FRAC_1_SQRT_2 * self.next());
        core::array::from_fn(|c| self.1[c] - before[c])
    }

    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((self.0 >> 11) as f64 / (1u64 << 53) as f64 - 0.5) * 12.0_f64.sqrt()
    }
}

/// A buffer as R_B expects it: white normalised innovations, sensors that differ by their noise.
fn usual(k: i64, noise: &mut Noise) -> WatchedBuffer {
    let normalised = core::array::from_fn(|_| noise.next());
    WatchedBuffer {
        stamps_ns: [k * SECOND_NS, (k + 1) * SECOND_NS],
        nis: normalised.iter().map(|v: &f64| v * v).sum::<f64>() / 6.0,
        normalised,
        mean: normalised.map(|v| 0.05 * v),
        contradiction: noise.contradiction(),
        weighed: [1.0, 0.9],
    }
}

#[test]
fn property_usual_buffers_raise_nothing() {
    for seed in 0..20 {
        let (mut watch, mut noise) = (Watch::default(), Noise::of(seed));
        let told: Vec<Alarm> = (0..200).flat_map(|k| watch.feed(usual(k, &mut noise))).collect();
        assert_eq!(told, [], "seed {seed}");
    }
}

#[test]
fn analytic_each_change_is_told_once_by_its_test_and_dated() {
    type Change = fn(&mut WatchedBuffer);
    // Kind, channel, size in the unit of the channel, change from buffer 30 to 59, the longest delay in s that the sums allow.
    let changes: [(AlarmKind, &str, f64, Change, i64); 4] = [
        // 0.02 rad of turn in each second: (0.02 n)² = 49 (0.003² + n 0.0015²) at n = 2.
        (AlarmKind::SensorJump, "turn_minus_gyro_yaw_rad_s", -0.02, |b| b.contradiction[5] -= 0.02, 3),
        // 4 standard deviations in each buffer: 4 n = 6 √n at n = 2.3, and noise.
        (AlarmKind::MotionJump, "forward_m_s", 0.2, |b| (b.normalised[0], b.mean[0]) = (b.normalised[0] + 4.0, b.mean[0] + 0.2), 4),
        // A mean of 6 buffers beyond 3.5 when the new ones have 8.
        (AlarmKind::NisLarge, "", 0.0, |b| b.nis = 8.0, 4),
        (AlarmKind::NisSmall, "", 0.0, |b| (b.nis, b.normalised) = (0.01, b.normalised.map(|v| 0.1 * v)), 12),
    ];
    for (kind, channel, size, change, delay) in changes {
        let (mut watch, mut noise) = (Watch::default(), Noise::of(7));
        let mut told = Vec::new();
        for k in 0..120 {
            let mut buffer = usual(k, &mut noise);
            if (30..60).contains(&k) {
                change(&mut buffer);
            }
            told.extend(watch.feed(buffer));
        }
        assert_eq!(told.len(), 2, "{kind:?}: {told:?}");
        let [raised, cleared] = [told[0], told[1]];
        assert_eq!((raised.kind, raised.channel_name(), raised.active, raised.episode), (kind, channel, true, 1));
        assert_eq!((cleared.kind, cleared.active, cleared.episode), (kind, false, 1));
        let after = raised.stamp_ns / SECOND_NS - 30;
        assert!((1..=delay).contains(&after), "{kind:?} after {after} s");
        assert!((raised.onset_ns / SECOND_NS - 30).abs() <= if kind == AlarmKind::NisSmall { 2 } else { 1 }, "{kind:?}: {raised:?}");
        assert!((raised.size - size).abs() <= 0.3 * size.abs(), "{kind:?}: {raised:?}");
        assert!(cleared.stamp_ns > 60 * SECOND_NS && cleared.stamp_ns < 85 * SECOND_NS, "{kind:?}: {cleared:?}");
        assert!(watch.active.is_none() && watch.episodes == 1);
    }
}

#[test]
fn analytic_the_same_error_again_and_again_is_correlated() {
    // Each channel errs by ±1.3 standard deviations, the sign changing from channel to channel and never in time: 1.3 √12 = 4.5 is no jump.
    let mut watch = Watch::default();
    let mut told = (0..12).flat_map(|k| {
        let normalised = core::array::from_fn(|c| if c % 2 == 0 { 1.3 } else { -1.3 });
        watch.feed(WatchedBuffer { normalised, nis: 1.0, contradiction: [0.0; CONTRADICTIONS], ..usual(k, &mut Noise::of(1)) })
    });
    let told = told.next();
    assert!(told.is_some_and(|alarm| alarm.kind == AlarmKind::Correlated && alarm.statistic > 0.99), "{told:?}");
}

#[test]
fn analytic_sensors_are_told_of_while_another_alarm_is_active() {
    // From buffer 30 on another soil, from 45 on a gyro that errs by 0.02 rad/s; both end at 60.
    let (mut watch, mut noise) = (Watch::default(), Noise::of(11));
    let mut told = Vec::new();
    for k in 0..120 {
        let mut buffer = usual(k, &mut noise);
        buffer.nis = if (30..60).contains(&k) { 8.0 } else { buffer.nis };
        buffer.contradiction[5] -= if (45..60).contains(&k) { 0.02 } else { 0.0 };
        told.extend(watch.feed(buffer));
    }
    let told_of: Vec<_> = told.iter().map(|alarm| (alarm.kind, alarm.episode, alarm.active)).collect();
    let [soil, sensor] = [AlarmKind::NisLarge, AlarmKind::SensorJump];
    assert_eq!(told_of, [(soil, 1, true), (soil, 1, false), (sensor, 2, true), (sensor, 2, false)]);
    assert!((46..=48).contains(&(told[2].stamp_ns / SECOND_NS)) && told[1].stamp_ns == told[2].stamp_ns, "{told:?}");
}

#[test]
fn analytic_without_a_prediction_sensors_alone_are_judged() {
    let unpredicted = |k: i64, noise: &mut Noise, off: f64| {
        let mut contradiction = noise.contradiction();
        contradiction[0] -= off;
        WatchedBuffer::new([k * SECOND_NS, (k + 1) * SECOND_NS], None, contradiction, [0.0; CONTRADICTIONS])
    };
    let (mut watch, mut noise) = (Watch::default(), Noise::of(13));
    let usual_ones: Vec<Alarm> = (0..60).flat_map(|k| watch.feed(unpredicted(k, &mut noise, 0.0))).collect();
    assert_eq!(usual_ones, []);
    let raised: Vec<Alarm> = (60..80).flat_map(|k| watch.feed(unpredicted(k, &mut noise, 0.2))).collect();
    assert!(matches!(raised[..], [Alarm { kind: AlarmKind::SensorJump, active: true, .. }]), "{raised:?}");
    // An alarm of motion is not over because the map ends.
    let mut watch = Watch::default();
    let begun: Vec<Alarm> = (0..6).flat_map(|k| watch.feed(WatchedBuffer { nis: 8.0, ..usual(k, &mut noise) })).collect();
    assert!(matches!(begun[..], [Alarm { kind: AlarmKind::NisLarge, active: true, .. }]), "{begun:?}");
    let ended: Vec<Alarm> = (6..40).flat_map(|k| watch.feed(unpredicted(k, &mut noise, 0.0))).collect();
    assert_eq!((ended, watch.active), (Vec::new(), Some(begun[0])));
}

#[test]
fn analytic_a_blow_between_two_samples_is_no_fault_of_sensors() {
    // The nose is thrown up at 1.1 rad/s somewhere between two samples, 0.1 s apart: integrated wrongly by up to 0.055 rad.
    let struck = |unseen_rad: f64| {
        let (mut watch, mut noise) = (Watch::default(), Noise::of(17));
        let told: Vec<Alarm> = (0..20)
            .flat_map(|k| {
                let (mut contradiction, mut unseen) = (noise.contradiction(), [0.0; CONTRADICTIONS]);
                if k == 10 {
                    (contradiction[4], unseen[4]) = (-0.05, unseen_rad);
                }
                watch.feed(WatchedBuffer::new([k * SECOND_NS, (k + 1) * SECOND_NS], None, contradiction, unseen))
            })
            .collect();
        told.len()
    };
    assert_eq!(struck(0.055), 0);
    // Where samples show no blow it is the sensors.
    assert!(struck(0.01) > 0);
}

#[test]
fn property_a_gap_forgives_the_noise_of_its_ends() {
    // The noise of positions telescopes over buffers that follow each other; over buffers that do not it adds up, and the bound knows.
    let (mut together, mut apart, mut noise) = (Watch::default(), Watch::default(), Noise::of(3));
    for k in 0..12 {
        let buffer = WatchedBuffer { contradiction: [0.013, 0.0, 0.0, 0.0, 0.0, 0.0], ..usual(k, &mut noise) };
        together.feed(buffer);
        apart.feed(WatchedBuffer { stamps_ns: buffer.stamps_ns.map(|s| s + k * SECOND_NS), ..buffer });
    }
    let statistic = |watch: &Watch| watch.sensor_jump().unwrap().statistic;
    assert!(statistic(&together) > 1.2 * statistic(&apart), "{} {}", statistic(&together), statistic(&apart));
}

#[test]
fn property_numbers_that_are_not_finite_leave_no_trace_and_values_round_trip() {
    let (mut watch, mut noise) = (Watch::default(), Noise::of(5));
    for k in 0..9 {
        watch.feed(usual(k, &mut noise));
    }
    let before = watch.clone();
    assert_eq!(watch.feed(WatchedBuffer { nis: f64::NAN, ..usual(9, &mut noise) }), []);
    assert_eq!(watch, before);
    for buffer in &watch.window {
        assert_eq!(WatchedBuffer::from_values(buffer.stamps_ns, &buffer.to_values()), *buffer);
    }
    assert!(watch.is_possible());
    watch.window[2].stamps_ns = [5, 5];
    assert!(!watch.is_possible());
}
