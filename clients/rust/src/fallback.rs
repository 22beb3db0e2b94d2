//! A declared fallback for planners that must have an answer.

use std::borrow::Cow;
use std::f64::consts::{PI, TAU};

use nesam_proto::packed::unpack;
use nesam_proto::v1;
use tonic::Code;

use crate::error::ClientError;
use crate::known_states::{Known, KnownState};
use crate::prediction::{Candidates, ComputedBy, ExtraOutputs, FallbackReason, Prediction};
use crate::refused;

/// Entries of a state.
const STATE: usize = 12;

/// Steps that a known state is rolled forward at most, as in the service.
const ROLLED_FORWARD_STEPS_MAX: usize = 32;

/// Whether a fallback may answer instead: the service is late, overloaded or away, or what it knows of the session is too old to be rolled forward.
fn is_late(code: Code, field: &str) -> bool {
    let late = [Code::DeadlineExceeded, Code::ResourceExhausted, Code::Unavailable].contains(&code);
    late || (code == Code::FailedPrecondition && field == "start_stamp_ns")
}

/// Flat-ground kinematics of a vehicle card: the commanded speed is reached at once, a bicycle turns with tan(angle) / wheelbase, a skid-steer vehicle
/// with the commanded yaw rate. It knows no terrain, soil or slip; height, roll and pitch stay those of the start. It answers only where a caller puts
/// it into [`Candidates::fallback`], and the prediction says so in [`Prediction::computed_by`].
#[derive(Clone, Debug, PartialEq)]
pub struct KinematicFallback {
    /// Vehicle card, as a session tells it.
    pub vehicle: v1::VehicleCard,
    /// Step, s.
    pub dt_s: f64,
}

impl KinematicFallback {
    /// The kinematics of a card in steps of 0.1 s, those of the service.
    pub fn new(vehicle: v1::VehicleCard) -> Self {
        Self { vehicle, dt_s: 0.1 }
    }

    /// Yaw rate that a command means.
    pub fn yaw_rate_rad_s(&self, speed_m_s: f64, second: f64) -> f64 {
        let kind = self.vehicle.second();
        if kind == v1::SecondCommand::YawRateRadS {
            return second;
        }
        let normalised = kind == v1::SecondCommand::SteeringNormalised;
        let angle_rad = if normalised { second * self.vehicle.road_wheel_angle_max_rad } else { second };
        speed_m_s * angle_rad.tan() / self.vehicle.wheelbase_m
    }

    /// Whether the service would take these commands, pairs of speed and second: finite and within the card's range. In single precision, so that the ends of
    /// the range are admitted in both.
    fn admits(&self, commands: &[f32]) -> bool {
        let card = &self.vehicle;
        let range = [[card.speed_min_m_s, card.speed_max_m_s], [card.second_min, card.second_max]].map(|ends| ends.map(|end| end as f32));
        commands.chunks_exact(2).all(|command| command.iter().zip(range).all(|(value, [low, high])| (low..=high).contains(value)))
    }

    /// States, row-major (samples, horizon, 12), from a start and controls, row-major (samples, horizon, 2). Numbers at the end that make no whole sample
    /// are left out.
    pub fn rollout(&self, start: &[f64; STATE], controls: &[f32], horizon: usize) -> Vec<f32> {
        let mut states = Vec::with_capacity(controls.len() / 2 * STATE);
        for sample in controls.chunks_exact((2 * horizon).max(1)) {
            let mut state = *start;
            for command in sample.chunks_exact(2) {
                let (speed, second) = (f64::from(command[0]), f64::from(command[1]));
                self.step(&mut state, speed, self.yaw_rate_rad_s(speed, second));
                states.extend(state.iter().map(|value| *value as f32));
            }
        }
        states
    }

    /// Moves a state by one step at a speed and a yaw rate.
    fn step(&self, state: &mut [f64; STATE], speed_m_s: f64, rate_rad_s: f64) {
        let half_turn = 0.5 * rate_rad_s * self.dt_s;
        // Exact for an arc: the chord is speed dt sin(h) / h with h = half of the turned angle.
        let chord = speed_m_s * self.dt_s * if half_turn == 0.0 { 1.0 } else { half_turn.sin() / half_turn };
        let (sin_middle, cos_middle) = (state[5] + half_turn).sin_cos();
        state[0] += chord * cos_middle;
        state[1] += chord * sin_middle;
        state[5] = PI - (PI - (state[5] + rate_rad_s * self.dt_s)).rem_euclid(TAU);
        state[6..].copy_from_slice(&[speed_m_s, 0.0, 0.0, 0.0, 0.0, rate_rad_s]);
    }

    fn step_ns(&self) -> i64 {
        ((self.dt_s * 1e9).round() as i64).max(1)
    }

    /// Steps between two instants, rounded to the nearest.
    fn steps(&self, from_ns: i64, until_ns: i64) -> i128 {
        let step_ns = i128::from(self.step_ns());
        (2 * (i128::from(until_ns) - i128::from(from_ns)) + step_ns).div_euclid(2 * step_ns)
    }

    /// Where a prediction without a given start begins, `None` where nothing that is known serves. Without an instant it is the measured state. A state that the
    /// service rolled forward is no measurement: it serves where it is not later than the instant and no newer measurement is known.
    fn begins(&self, known: Known, until_ns: Option<i64>, sent: &[(i64, [f64; 2])]) -> Option<KnownState> {
        let Some(until_ns) = until_ns else {
            return known.measured.or(known.ahead);
        };
        let serves = |ahead: &KnownState| {
            let since_ns = i128::from(ahead.stamp_ns) - ahead.rolled_forward_steps as i128 * i128::from(self.step_ns());
            self.steps(ahead.stamp_ns, until_ns) >= 0 && known.measured.is_none_or(|measured| i128::from(measured.stamp_ns) <= since_ns)
        };
        self.rolled_forward(known.ahead.filter(serves).or(known.measured)?, until_ns, sent)
    }

    /// A known state rolled forward to an instant, rounded to the nearest step; `None` where it lies too far after the measurement, and itself where it is
    /// earlier. Each step uses the command that is in effect at its middle; before the first of them the vehicle goes on as it moves.
    fn rolled_forward(&self, known: KnownState, until_ns: i64, sent: &[(i64, [f64; 2])]) -> Option<KnownState> {
        let step_ns = self.step_ns();
        let since_ns = |stamp_ns: i64| i128::from(stamp_ns) - i128::from(known.stamp_ns);
        let steps = usize::try_from(self.steps(known.stamp_ns, until_ns).max(0)).ok()?;
        let rolled_forward_steps = known.rolled_forward_steps.checked_add(steps).filter(|all| *all <= ROLLED_FORWARD_STEPS_MAX)?;
        let mut state = known.state;
        for step in 0..steps as i128 {
            let in_effect = sent.iter().take_while(|(stamp_ns, _)| 2 * since_ns(*stamp_ns) <= (2 * step + 1) * i128::from(step_ns)).last();
            let (speed, rate) = match in_effect {
                Some((_, [speed, second])) => (*speed, self.yaw_rate_rad_s(*speed, *second)),
                None => (state[6], state[11]),
            };
            self.step(&mut state, speed, rate);
        }
        Some(KnownState { state, stamp_ns: known.stamp_ns.saturating_add(steps as i64 * step_ns), rolled_forward_steps })
    }

    /// What it answers instead of the service, and why. `None` where the error is no lateness, where there is neither a start nor a known state that is new
    /// enough, or where the candidates contradict themselves or are not what the service takes: a number that is none, a command
    /// beyond the card, a shape, start or cost beyond the limits.
    pub(crate) fn answer(&self, candidates: &Candidates, known: Known, error: &ClientError) -> Option<Prediction> {
        let reason = match error {
            ClientError::Refused { code, field, message, .. } if is_late(*code, field) => {
                FallbackReason { code: *code, message: message.clone() }
            }
            _ => return None,
        };
        let sent: Vec<f32> = candidates.sent.iter().flat_map(|(_, command)| command.map(|value| value as f32)).collect();
        if !refused::takes(candidates) || !self.admits(&sent) {
            return None;
        }
        let (start, start_stamp_ns, rolled_forward_steps) = match candidates.start {
            Some(start) => (start, None, 0),
            None => {
                let begin = self.begins(known, candidates.start_stamp_ns, &candidates.sent)?;
                (begin.state, Some(begin.stamp_ns), begin.rolled_forward_steps)
            }
        };
        let (samples, controls) = match &candidates.drawing {
            Some(drawing) => (1, Cow::Owned(unpack(&drawing.nominal))),
            None => (candidates.samples, Cow::Borrowed(candidates.controls.as_slice())),
        };
        let horizon = candidates.horizon;
        if controls.is_empty() || controls.len() != samples.checked_mul(horizon)?.checked_mul(2)? || !self.admits(&controls) {
            return None;
        }
        let asked = candidates.output.channels;
        let channels: Vec<usize> = (0..STATE).filter(|i| asked == 0 || asked >> i & 1 == 1).collect();
        let stride = (candidates.output.stride as usize).max(1);
        let mut states = Vec::with_capacity(samples * (horizon / stride) * channels.len());
        for sample in self.rollout(&start, &controls, horizon).chunks_exact(STATE * horizon) {
            for state in sample.chunks_exact(STATE).skip(stride - 1).step_by(stride) {
                states.extend(channels.iter().map(|channel| state[*channel]));
            }
        }
        Some(Prediction {
            tag: candidates.tag,
            samples,
            steps: horizon / stride,
            channels,
            states,
            sinkage_m: Vec::new(),
            validity: vec![0; samples],
            start,
            start_stamp_ns,
            rolled_forward_steps,
            history_steps: 0,
            soil: [f64::NAN; 6],
            soil_variance: None,
            soil_correction: v1::SoilCorrection::default(),
            measurement_age_s: None,
            provenance: v1::Provenance::default(),
            queue_s: 0.0,
            compute_s: 0.0,
            soil_groups: 1,
            extras: ExtraOutputs::default(),
            drawn_controls: if candidates.drawing.is_some() { controls.into_owned() } else { Vec::new() },
            costs: Vec::new(),
            best: Vec::new(),
            mean_controls: Vec::new(),
            computed_by: ComputedBy::KinematicFallback,
            fallback_reason: Some(reason),
        })
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn card(second: v1::SecondCommand, wheelbase_m: f64) -> v1::VehicleCard {
        v1::VehicleCard {
            second: second.into(),
            speed_min_m_s: -2.0,
            speed_max_m_s: 4.0,
            second_min: -1.0,
            second_max: 1.0,
            wheelbase_m,
            road_wheel_angle_max_rad: 0.5,
            ..Default::default()
        }
    }

    fn late() -> ClientError {
        tonic::Status::deadline_exceeded("no answer came in time").into()
    }

    fn known(state: [f64; STATE], stamp_ns: i64) -> Known {
        Known { measured: Some(KnownState { state, stamp_ns, rolled_forward_steps: 0 }), ahead: None }
    }

    /// Goal: the fallback is the one of the Python client. Method: x, y, yaw, vx, wz that `nesam.KinematicFallback` gives for the same start, commands and
    /// cards, with a yaw that passes pi both ways. Tolerance: some units in the last place of f32.
    #[test]
    fn regress_the_numbers_of_the_python_client() {
        use v1::SecondCommand::{RoadWheelAngleRad, SteeringNormalised, YawRateRadS};
        let start = [1.0, 2.0, 0.5, 0.05, -0.02, 3.1, 1.0, 0.1, 0.0, 0.0, 0.0, 0.2];
        let controls = [2.0, 0.5, 1.5, -0.25, -1.0, 0.5, 0.0, 1.0];
        let expected = [
            (
                card(SteeringNormalised, 3.25),
                [
                    [0.800115883, 2.00674582, 3.11571336, 2.0, 0.15713349],
                    [0.650178194, 2.01106215, 3.10991383, 1.5, -0.0579946786],
                    [0.75011456, 2.00750208, 3.10205722, -1.0, -0.0785667449],
                    [0.75011456, 2.00750208, 3.10205722, 0.0, 0.0],
                ],
            ),
            (
                card(RoadWheelAngleRad, 2.5),
                [
                    [0.800054908, 2.0039475, -3.13948107, 2.0, 0.437041998],
                    [0.650058687, 2.00477982, 3.12838364, 1.5, -0.153205156],
                    [0.750027537, 2.00236654, 3.10653162, -1.0, -0.218520999],
                    [0.750027537, 2.00236654, 3.10653162, 0.0, 0.0],
                ],
            ),
            (
                card(YawRateRadS, 1.0),
                [
                    [0.800048351, 2.00331807, -3.13318539, 2.0, 0.5],
                    [0.650053501, 2.003932, 3.125, 1.5, -0.25],
                    [0.750039577, 2.00477266, -3.10818529, -1.0, 0.5],
                    [0.750039577, 2.00477266, -3.00818539, 0.0, 1.0],
                ],
            ),
        ];
        for (vehicle, rows) in expected {
            let states = KinematicFallback::new(vehicle).rollout(&start, &controls, 4);
            assert_eq!(states.len(), 4 * STATE);
            for (state, row) in states.chunks_exact(STATE).zip(rows) {
                for (channel, value) in [0, 1, 5, 6, 11].into_iter().zip(row) {
                    assert!((f64::from(state[channel]) - value).abs() < 1e-6, "channel {channel}: {} for {value}", state[channel]);
                }
                assert_eq!((&state[2..5], &state[7..11]), ([0.5_f32, 0.05, -0.02].as_slice(), [0.0_f32; 4].as_slice()));
            }
        }
    }

    /// Goal: straight lines and arcs come out exactly. Method: a bicycle to the north, straight on and to the left; the second has to stay at its radius
    /// from a centre to the left. Tolerance: single precision at some metres.
    #[test]
    fn analytic_a_fallback_drives_arcs() {
        let mut start = [0.0; STATE];
        start[5] = 0.5 * PI;
        let controls: Vec<f32> = (0..64).flat_map(|step| [2.0, if step < 32 { 0.0 } else { 0.3 }]).collect();
        let states = KinematicFallback::new(card(v1::SecondCommand::RoadWheelAngleRad, 2.5)).rollout(&start, &controls, 32);
        let radius = 2.5 / f64::from(0.3_f32).tan();
        for k in 0..32 {
            let (ahead, turning) = (&states[STATE * k..], &states[STATE * (32 + k)..]);
            assert!((f64::from(ahead[1]) - 0.2 * (k + 1) as f64).abs() < 1e-5 && ahead[0].abs() < 1e-5, "{k}");
            assert!(((f64::from(turning[0]) + radius).hypot(f64::from(turning[1])) - radius).abs() < 1e-4, "{k}");
            assert!((f64::from(turning[11]) - 2.0 / radius).abs() < 1e-6, "{k}");
        }
    }

    /// Goal: what the service would refuse is no answer of the fallback either. Method: the ends of the range in single precision, then one step beyond each.
    #[test]
    fn analytic_a_fallback_takes_what_the_service_takes() {
        let fallback = KinematicFallback::new(card(v1::SecondCommand::YawRateRadS, 1.0));
        let answers = |controls: Vec<f32>, start: [f64; STATE]| {
            let asked = Candidates { start: Some(start), ..Candidates::new("s", 1, 2, controls) };
            fallback.answer(&asked, Known::default(), &late()).is_some()
        };
        assert!(answers(vec![4.0, -1.0, -2.0, 1.0], [0.0; STATE]));
        for beyond in [[4.001, 0.0], [-2.001, 0.0], [0.0, 1.001], [0.0, -1.001], [f32::NAN, 0.0], [0.0, f32::INFINITY]] {
            assert!(!answers([[0.0, 0.0], beyond].concat(), [0.0; STATE]), "{beyond:?}");
        }
        assert!(!answers(vec![0.0; 4], [f64::NAN; STATE]));
        let from_now = Candidates::new("s", 1, 1, vec![0.0; 2]).starting_at(100_000_000, vec![(0, [9.0, 0.0])]);
        assert!(fallback.answer(&from_now, known([0.0; STATE], 0), &late()).is_none(), "a command that was never taken");
    }

    /// Goal: what was selected is returned and marked. Method: two candidates, every second step, two channels; then the nominal sequence of a drawing.
    #[test]
    fn analytic_a_fallback_answers_what_was_asked_and_says_so() {
        let fallback = KinematicFallback::new(card(v1::SecondCommand::YawRateRadS, 1.0));
        let start = [3.0; STATE];
        let mut asked = Candidates::new("s", 2, 5, vec![1.0; 20]);
        (asked.output.channels, asked.output.stride, asked.tag) = ((1 << 1) | (1 << 6), 2, 9);
        let answered = fallback.answer(&asked, known(start, 7), &late()).unwrap();
        let whole = fallback.rollout(&start, &asked.controls, 5);
        assert_eq!((answered.computed_by, answered.tag, answered.samples, answered.steps), (ComputedBy::KinematicFallback, 9, 2, 2));
        assert_eq!(answered.state(1, 1), [whole[STATE * 8 + 1], whole[STATE * 8 + 6]]);
        assert_eq!((answered.channels, answered.validity, answered.start), (vec![1, 6], vec![0, 0], start));
        assert_eq!(answered.fallback_reason.unwrap().code, Code::DeadlineExceeded);
        assert!(
            answered.soil.iter().all(|value| value.is_nan()) && answered.provenance.bundle_hash.is_empty() && answered.sinkage_m.is_empty()
        );
        let drawn = Candidates::drawn("s", 64, &[1.0, 0.1, 1.0, 0.2], v1::CandidateDrawing::default());
        let nominal = fallback.answer(&drawn, known(start, 7), &late()).unwrap();
        assert_eq!((nominal.samples, nominal.states), (1, fallback.rollout(&start, &[1.0, 0.1, 1.0, 0.2], 2)));
        assert_eq!((nominal.drawn_controls, nominal.start_stamp_ns), (vec![1.0, 0.1, 1.0, 0.2], Some(7)));
    }

    /// Goal: a planner that asks from now gets the kinematics from then. Method: a state that turns, one command that comes into effect in the middle of the
    /// second step; instants on both sides of half a step and of the longest way. Tolerance: rounding of f64.
    #[test]
    fn analytic_a_known_state_is_rolled_forward_with_what_was_sent() {
        let fallback = KinematicFallback::new(card(v1::SecondCommand::YawRateRadS, 1.0));
        let mut state = [0.0; STATE];
        (state[6], state[11]) = (3.0, 0.5);
        let begin = known(state, 1_000_000_000);
        let from = |instant_ns: i64| {
            let asked = Candidates::new("s", 1, 1, vec![1.0, 0.0]).starting_at(instant_ns, vec![(1_150_000_000, [2.0, 0.0])]);
            fallback.answer(&asked, begin, &late())
        };
        let ahead = from(1_290_000_000).unwrap();
        assert_eq!((ahead.start_stamp_ns, ahead.rolled_forward_steps), (Some(1_300_000_000), 3));
        let (sin, cos) = 0.05_f64.sin_cos();
        // An arc of radius 6 m for one step, then straight on for two.
        for (entry, value) in [(0, 6.0 * sin + 0.4 * cos), (1, 6.0 * (1.0 - cos) + 0.4 * sin), (5, 0.05), (6, 2.0), (11, 0.0)] {
            assert!((ahead.start[entry] - value).abs() < 1e-12, "{entry}: {} for {value}", ahead.start[entry]);
        }
        for instant_ns in [1_049_000_000, 1_000_000_000, i64::MIN] {
            let same = from(instant_ns).unwrap();
            assert_eq!((same.start, same.start_stamp_ns, same.rolled_forward_steps), (state, Some(1_000_000_000), 0));
        }
        assert_eq!(from(4_200_000_000).unwrap().rolled_forward_steps, 32);
        assert!(from(4_300_000_000).is_none() && from(i64::MAX).is_none(), "what is known is too old");
    }

    /// Goal: a fallback begins no later than it is asked to where a measurement says where the vehicle was before. Method: a measurement at 1 s and a state that the
    /// service rolled forward from it to 1.8 s; questions from instants before and after that, and a plain one; then a newer measurement, and none.
    #[test]
    fn regress_a_fallback_begins_no_later_than_it_is_asked_to() {
        let fallback = KinematicFallback::new(card(v1::SecondCommand::YawRateRadS, 1.0));
        let ahead = |from_ns: i64| KnownState { state: [7.0; STATE], stamp_ns: from_ns, rolled_forward_steps: 8 };
        let both = Known { ahead: Some(ahead(1_800_000_000)), ..known([3.0; STATE], 1_000_000_000) };
        let begin = |known: Known, instant_ns: Option<i64>| {
            let asked = Candidates { start_stamp_ns: instant_ns, ..Candidates::new("s", 1, 1, vec![1.0, 0.0]) };
            let answered = fallback.answer(&asked, known, &late())?;
            Some((answered.start_stamp_ns.unwrap(), answered.rolled_forward_steps, answered.start[2]))
        };
        assert_eq!(begin(both, None), Some((1_000_000_000, 0, 3.0)), "what was measured");
        assert_eq!(begin(both, Some(1_100_000_000)), Some((1_100_000_000, 1, 3.0)));
        assert_eq!(begin(both, Some(1_800_000_000)), Some((1_800_000_000, 8, 7.0)), "as the service rolled it");
        assert_eq!(begin(both, Some(1_900_000_000)), Some((1_900_000_000, 9, 7.0)), "steps count from the measurement");
        assert_eq!(begin(both, Some(4_200_000_000)), Some((4_200_000_000, 32, 7.0)));
        assert_eq!(begin(both, Some(4_300_000_000)), None);
        let newer = Known { ahead: both.ahead, ..known([3.0; STATE], 1_100_000_000) };
        assert_eq!(begin(newer, Some(1_900_000_000)), Some((1_900_000_000, 8, 3.0)), "a newer measurement");
        let alone = Known { ahead: both.ahead, measured: None };
        assert_eq!(begin(alone, None), Some((1_800_000_000, 8, 7.0)), "nothing else is known");
        assert_eq!((begin(alone, Some(1_900_000_000)), begin(alone, Some(1_100_000_000))), (Some((1_900_000_000, 9, 7.0)), None));
    }

    /// Goal: nothing but lateness is answered, and nothing is made up. Method: other errors, no state, controls without their shape.
    #[test]
    fn analytic_a_fallback_keeps_out_of_everything_else() {
        let fallback = KinematicFallback::new(card(v1::SecondCommand::YawRateRadS, 1.0));
        let asked = Candidates::new("s", 1, 1, vec![1.0, 0.0]);
        let known = known([0.0; STATE], 0);
        for status in [tonic::Status::resource_exhausted(""), tonic::Status::unavailable("")] {
            assert!(fallback.answer(&asked, known, &status.into()).is_some());
        }
        for status in [tonic::Status::invalid_argument(""), tonic::Status::not_found(""), tonic::Status::failed_precondition("")] {
            assert!(fallback.answer(&asked, known, &status.into()).is_none());
        }
        assert!(fallback.answer(&asked, known, &ClientError::protocol("a part is missing")).is_none());
        let refusal = |field: &str| {
            let (field, message) = (field.into(), "no measurement is new enough".into());
            ClientError::Refused { code: Code::FailedPrecondition, field, message, retry_after: None }
        };
        let from_now = asked.clone().starting_at(300_000_000, Vec::new());
        let stalled = fallback.answer(&from_now, known, &refusal("start_stamp_ns")).unwrap();
        assert_eq!((stalled.rolled_forward_steps, stalled.fallback_reason.unwrap().code), (3, Code::FailedPrecondition));
        assert!(fallback.answer(&from_now, known, &refusal("")).is_none(), "the session has no measurement");
        assert!(fallback.answer(&asked, Known::default(), &late()).is_none());
        let given = Candidates { start: Some([0.0; STATE]), ..asked.clone() };
        assert!(fallback.answer(&given, Known::default(), &late()).is_some());
        for (samples, horizon) in [(2, 1), (1, 2), (usize::MAX, 2), (0, 1)] {
            assert!(fallback.answer(&Candidates { samples, horizon, ..asked.clone() }, known, &late()).is_none(), "{samples} x {horizon}");
        }
        assert!(fallback.answer(&Candidates::new("s", 0, 0, Vec::new()), known, &late()).is_none());
    }
}
