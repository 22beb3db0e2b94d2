//! What keeps a network from learning drives by heart: in each training step a window is seen a little otherwise.
//!
//! A few hundred drives have fixed noise and fixed places, and a window can be recognised by either. So some terrain features are left out, the terrain is
//! seen from poses near the driven one, and the sensors' noise is drawn anew; what is to be predicted stays what was measured.

use nesam_physics::{STATE_DIM, VehicleState, wrap_angle};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::drives::Drive;

/// How a window is varied in one training step.
#[derive(Clone, Copy, Debug)]
pub struct Variation {
    /// Share of the terrain features left out of the whole window, 0..1 (Srivastava et al. 2014).
    pub left_out: f32,
    /// Noise added to start and history, as a share of what the sensors have.
    pub noise: f64,
    /// Seed of this window in this step.
    pub seed: u64,
}

impl Variation {
    /// Factor of each of `n` features: 0, or what keeps the mean. `None` = none is left out.
    pub fn factors(&self, n: usize) -> Option<Vec<f32>> {
        let mut rng = self.stream(0);
        let kept = 1.0 / (1.0 - self.left_out);
        (self.left_out > 0.0).then(|| (0..n).map(|_| if rng.random::<f32>() < self.left_out { 0.0 } else { kept }).collect())
    }

    /// Which of `views` views each of `samples` samples is seen in.
    pub fn views(&self, samples: usize, views: usize) -> Vec<usize> {
        let mut rng = self.stream(1);
        (0..samples).map(|_| rng.random_range(0..views)).collect()
    }

    /// The states with further noise of the sensors, whose standard deviations are `noise_sd`.
    pub fn measured_again(&self, states: &[VehicleState<f64>], noise_sd: &[f64; STATE_DIM]) -> Vec<VehicleState<f64>> {
        if self.noise == 0.0 {
            return states.to_vec();
        }
        let mut rng = self.stream(2);
        let again = |state: &VehicleState<f64>| {
            let mut values = state.to_array();
            for (value, sd) in values.iter_mut().zip(noise_sd) {
                *value += self.noise * sd * rng.sample::<f64, _>(StandardNormal);
            }
            values[5] = wrap_angle(values[5]);
            VehicleState::from_array(values)
        };
        states.iter().map(again).collect()
    }

    fn stream(&self, index: u64) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(index);
        rng
    }
}

/// Standard deviation of the sensors' white noise in each entry of the state, told from the drives themselves.
///
/// The third difference of white noise of deviation σ has the variance 20 σ², and what a vehicle does in a few steps is close to a parabola. Where it is
/// not, motion passes for noise: the median over a drive, and of all drives the tenth with the least, keep most of it out.
pub fn sensor_noise(drives: &[&Drive]) -> [f64; STATE_DIM] {
    /// Median of |x| of a standard normal x.
    const MEDIAN_ABSOLUTE: f64 = 0.674_49;
    let quantile = |values: &mut Vec<f64>, share: f64| {
        let at = ((values.len().saturating_sub(1)) as f64 * share) as usize;
        values.sort_unstable_by(f64::total_cmp);
        values.get(at).copied().unwrap_or(0.0)
    };
    core::array::from_fn(|entry| {
        let mut by_drive: Vec<f64> = drives
            .iter()
            .filter(|drive| drive.states.len() > 3)
            .map(|drive| {
                let third = |s: &[VehicleState<f64>]| {
                    let [a, b, c, d] = [0, 1, 2, 3].map(|i| s[i].to_array()[entry]);
                    // Angles are differences of neighbours first, which do not jump.
                    let step = |from: f64, to: f64| if entry == 5 { wrap_angle(to - from) } else { to - from };
                    (step(c, d) - 2.0 * step(b, c) + step(a, b)).abs()
                };
                let mut differences: Vec<f64> = drive.states.windows(4).map(third).collect();
                quantile(&mut differences, 0.5) / MEDIAN_ABSOLUTE / 20f64.sqrt()
            })
            .collect();
        quantile(&mut by_drive, 0.1)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nesam_physics::Control;

    const SD: [f64; STATE_DIM] = [0.015, 0.015, 0.02, 0.002, 0.002, 0.002, 0.025, 0.025, 0.025, 0.002, 0.002, 0.002];

    fn smooth(samples: usize) -> Vec<VehicleState<f64>> {
        let at = |i: usize| {
            let t = 0.1 * i as f64;
            let mut values = [0.0; STATE_DIM];
            // Turns through ±π, and swings slowly in everything else.
            (0..STATE_DIM).for_each(|k| values[k] = 0.3 * (0.4 * t + k as f64).sin());
            (values[0], values[5]) = (3.0 * t, wrap_angle(0.3 * t));
            VehicleState::from_array(values)
        };
        (0..samples).map(at).collect()
    }

    fn varied(seed: u64) -> Variation {
        Variation { left_out: 0.25, noise: 1.0, seed }
    }

    /// Noise of known size is put on a known motion and read off it.
    #[test]
    fn analytic_noise_is_read_off_a_moving_vehicle() {
        let states = varied(3).measured_again(&smooth(4000), &SD);
        let control = Control { speed_m_s: 0.0, second: 0.0 };
        let drive = Drive::new("noisy".into(), None, states.clone(), vec![control; states.len()]);
        for (entry, (found, sd)) in sensor_noise(&[&drive]).iter().zip(SD).enumerate() {
            // 4000 samples: the median of |x| scatters by 1.4 % of it, more as neighbours share samples.
            assert!((found / sd - 1.0).abs() < 0.08, "entry {entry}: {found} of {sd}");
        }
    }

    #[test]
    fn property_a_seed_varies_a_window_in_one_way_and_silence_in_none() {
        let states = smooth(40);
        assert_eq!(varied(5).measured_again(&states, &SD), varied(5).measured_again(&states, &SD));
        assert_ne!(varied(5).measured_again(&states, &SD), varied(6).measured_again(&states, &SD));
        let silent = Variation { left_out: 0.0, noise: 0.0, seed: 5 };
        assert_eq!(silent.measured_again(&states, &SD), states);
        assert!(silent.factors(10).is_none());
        let factors = varied(5).factors(20_000).expect("a quarter is left out");
        let mean = factors.iter().sum::<f32>() / 20_000.0;
        assert!((mean - 1.0).abs() < 0.02, "the mean stays: {mean}");
        let views = varied(5).views(3000, 3);
        assert!((0..3).all(|view| views.iter().filter(|v| **v == view).count().abs_diff(1000) < 100));
    }
}
