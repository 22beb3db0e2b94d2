//! Goal: effects act from their onsets on. Method: phases of a vehicle with three offsets.

use nesam_physics::effects::*;
use nesam_test_vehicles::truck;

#[test]
fn analytic_effects_begin_at_their_onsets() {
    let offset = |second: f64, onset_s: f64| ScheduledEffect { effect: Effect::SteeringOffset(SteeringOffset { second }), onset_s };
    let effects = [offset(0.1, 0.0), offset(0.2, 12.5), offset(0.4, 5.0)];
    let all = truck().with_effects(&effects.map(|e| e.effect));
    let phases = Phases::new(&all, &effects, |v| v.effects.actuator.steering_offset);
    for (time, want) in [(Some(0.0), 0.1), (Some(4.9), 0.1), (Some(5.0), 0.5), (Some(12.4), 0.5), (Some(12.5), 0.7), (None, 0.7)] {
        assert!((phases.at(time) - want).abs() < 1e-12, "{time:?}: {}", phases.at(time));
    }
}
