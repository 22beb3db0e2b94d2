//! Caution ahead of ground that will not hold the vehicle on the path.
//!
//! Candidates reach three seconds ahead. A vehicle that is to pass soft ground on a slope must have come slowly, and further inside, by then. So places of the path
//! further ahead are tried: from each of them, how far outside would the vehicle be after two seconds, whatever it steers? What slides is come to with caution: slowly from
//! well before, and inside the more the nearer it is, so that the vehicle comes to it heading inside and on a wider turn than the path's.

use std::collections::BTreeMap;

use serde::Serialize;

/// Edge of the cells of the path by which slides are remembered, m.
const CELL_M: f64 = 2.0;
/// Share by which a trial that slides less than the one before of its place counts.
const RELIEF: f64 = 0.1;

/// Part of the path about a place that slides where something is done about it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Stretch {
    /// How far before the place it begins, m of the path.
    pub lead_m: f64,
    /// Way over which it grows from nothing, and over which it fades, m.
    pub ramp_m: f64,
    /// How far behind the place it begins to fade, m.
    pub behind_m: f64,
}

impl Stretch {
    /// How much of what is to be done at a place is done `ahead_m` before it (negative: behind it), 0 to 1.
    fn reach(&self, ahead_m: f64) -> f64 {
        let reach = if ahead_m >= 0.0 { (self.lead_m - ahead_m) / self.ramp_m } else { 1.0 + (ahead_m + self.behind_m) / self.ramp_m };
        reach.clamp(0.0, 1.0)
    }
}

/// What is tried, and what is done about it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CautionSettings {
    /// How far ahead of the vehicle places are tried, m of the path.
    pub ahead_m: [f64; 4],
    /// Steps from trial to trial.
    pub every_steps: usize,
    /// Speed with which they are tried, m/s.
    pub trial_speed_m_s: f64,
    /// Slide up to which nothing is done, and from which on the vehicle is slowed down wholly, m.
    pub slowed_by_m: [f64; 2],
    /// Wanted speed then, m/s.
    pub slow_m_s: f64,
    /// Least and largest commanded speed then, m/s: braking on ground that slides is as bad as speed.
    pub slow_limits_m_s: [f64; 2],
    /// Where that is.
    pub slowed_over: Stretch,
    /// Slide up to which nothing is done, and from which on the path is moved wholly, m.
    pub moved_by_m: [f64; 2],
    /// By how much it is moved inside then, m.
    pub inside_m: f64,
    /// Where that is.
    pub moved_over: Stretch,
}

/// What trials have told of the path.
#[derive(Clone, Debug)]
pub struct Caution {
    settings: Option<CautionSettings>,
    /// Slide found at each cell of the path, m.
    slides_m: BTreeMap<i64, f64>,
}

impl Caution {
    /// Without settings there is none.
    pub fn new(settings: Option<CautionSettings>) -> Self {
        Self { settings, slides_m: BTreeMap::new() }
    }

    /// What to do, if anything.
    pub fn settings(&self) -> Option<&CautionSettings> {
        self.settings.as_ref()
    }

    /// Takes how far outside the vehicle would end that began at a place of the path. A trial that slides more than those of the place before counts at once, one that
    /// slides less by [`RELIEF`]: what is known of the soil comes and goes.
    pub fn note(&mut self, arc_m: f64, slide_m: f64) {
        let slide = self.slides_m.entry((arc_m / CELL_M).round() as i64).or_insert(slide_m);
        *slide += (slide_m - *slide) * if slide_m < *slide { RELIEF } else { 1.0 };
    }

    /// By how much the path is moved inside at a place, m.
    pub fn inside_m(&self, arc_m: f64) -> f64 {
        self.settings.map_or(0.0, |s| s.inside_m * self.share(&s.moved_over, arc_m, s.moved_by_m))
    }

    /// The wanted speed at a place where `usual_m_s` is wanted without caution.
    pub fn speed_m_s(&self, arc_m: f64, usual_m_s: f64) -> f64 {
        self.settings
            .map_or(usual_m_s, |s| usual_m_s + self.share(&s.slowed_over, arc_m, s.slowed_by_m) * (s.slow_m_s.min(usual_m_s) - usual_m_s))
    }

    /// Least and largest commanded speed at a place, `usual_m_s` without caution.
    pub fn speed_limits_m_s(&self, arc_m: f64, usual_m_s: [f64; 2]) -> [f64; 2] {
        let Some(s) = self.settings else { return usual_m_s };
        let share = self.share(&s.slowed_over, arc_m, s.slowed_by_m);
        std::array::from_fn(|i| usual_m_s[i] + share * (s.slow_limits_m_s[i].clamp(usual_m_s[0], usual_m_s[1]) - usual_m_s[i]))
    }

    /// How much of the most that can be done is done at a place, 0 to 1, for slides between these two.
    fn share(&self, over: &Stretch, arc_m: f64, [nothing_m, whole_m]: [f64; 2]) -> f64 {
        let cell = |m: f64| m / CELL_M;
        let near = cell(arc_m - over.behind_m - over.ramp_m).floor() as i64..=cell(arc_m + over.lead_m).ceil() as i64;
        let of = |(cell, slide_m): (&i64, &f64)| {
            ((slide_m - nothing_m) / (whole_m - nothing_m)).clamp(0.0, 1.0) * over.reach(*cell as f64 * CELL_M - arc_m)
        };
        self.slides_m.range(near).map(of).fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: CautionSettings = CautionSettings {
        ahead_m: [6.0, 10.0, 14.0, 18.0],
        every_steps: 10,
        trial_speed_m_s: 2.5,
        slowed_by_m: [1.0, 2.0],
        slow_m_s: 2.0,
        slow_limits_m_s: [1.5, 2.5],
        slowed_over: Stretch { lead_m: 12.0, ramp_m: 6.0, behind_m: 3.0 },
        moved_by_m: [1.5, 2.5],
        inside_m: 2.0,
        moved_over: Stretch { lead_m: 8.0, ramp_m: 8.0, behind_m: 0.0 },
    };

    /// A slide of 2 m at 40 m slows down wholly from 34 m to 43 m, from 28 m and to 49 m on; it moves the path by half of what it may, at the place itself, and evenly less to
    /// nothing 8 m before and behind it.
    #[test]
    fn analytic_caution_grows_before_a_slide_and_fades_behind_it() {
        let mut caution = Caution::new(Some(SETTINGS));
        assert_eq!((caution.inside_m(40.0), caution.speed_m_s(40.0, 3.0)), (0.0, 3.0));
        caution.note(40.0, 2.0);
        for (arc_m, speed_m_s, inside_m) in [
            (27.9, 3.0, 0.0),
            (31.0, 2.5, 0.0),
            (34.0, 2.0, 0.25),
            (40.0, 2.0, 1.0),
            (43.0, 2.0, 0.625),
            (46.0, 2.5, 0.25),
            (49.1, 3.0, 0.0),
        ] {
            assert!((caution.speed_m_s(arc_m, 3.0) - speed_m_s).abs() < 1e-12, "{arc_m}: {}", caution.speed_m_s(arc_m, 3.0));
            assert!((caution.inside_m(arc_m) - inside_m).abs() < 1e-12, "{arc_m}: {}", caution.inside_m(arc_m));
        }
        assert_eq!(caution.speed_limits_m_s(40.0, [0.5, 4.0]), [1.5, 2.5]);
        assert_eq!(caution.speed_limits_m_s(40.0, [0.5, 2.0]), [1.5, 2.0], "never beyond what is usual");
        assert_eq!(caution.speed_m_s(40.0, 1.0), 1.0, "who is slow already is not hurried");
        // A better trial counts by 0.1, a worse one at once.
        caution.note(40.3, 1.0);
        assert!((caution.speed_m_s(40.0, 3.0) - 2.1).abs() < 1e-12);
        caution.note(40.3, 2.0);
        assert_eq!(caution.speed_m_s(40.0, 3.0), 2.0);
    }

    /// Places of one slope, each moved for by itself, make one bend: the path is furthest inside where the slide is worst, and never jumps.
    #[test]
    fn property_a_path_that_is_moved_bends_and_does_not_jump() {
        let mut caution = Caution::new(Some(SETTINGS));
        for (arc_m, slide_m) in [(36.0, 1.7), (38.0, 2.1), (40.0, 2.4), (42.0, 2.0)] {
            caution.note(arc_m, slide_m);
        }
        let inside: Vec<f64> = (0..300).map(|i| caution.inside_m(25.0 + 0.1 * f64::from(i))).collect();
        let worst = inside.iter().copied().fold(0.0, f64::max);
        assert!((inside[150] - worst).abs() < 1e-9 && (worst - 1.8).abs() < 1e-9, "{worst}");
        let steepest = worst / SETTINGS.moved_over.ramp_m * 0.1;
        assert!(inside.windows(2).all(|w| (w[1] - w[0]).abs() < steepest + 1e-9), "{inside:?}");
        assert!(inside[0] == 0.0 && inside[299] == 0.0);
    }

    #[test]
    fn property_who_tries_nothing_is_as_he_was() {
        let mut caution = Caution::new(None);
        caution.note(40.0, 5.0);
        assert_eq!(
            (caution.inside_m(40.0), caution.speed_m_s(40.0, 3.0), caution.speed_limits_m_s(40.0, [0.5, 4.0])),
            (0.0, 3.0, [0.5, 4.0])
        );
    }
}
