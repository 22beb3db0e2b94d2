//! Candidate command sequences: given, or drawn as MPPI does.

use std::borrow::Cow;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rand_distr::{Distribution as _, StandardNormal};

use crate::error::EngineError;

/// N candidates of K steps, row-major (samples, horizon, 2): speed in m/s, second command in the unit of the card.
#[derive(Clone, Debug, PartialEq)]
pub enum Candidates {
    /// As they are.
    Given(Vec<f32>),
    /// To be drawn.
    Drawn(Drawing),
}

impl Candidates {
    /// The commands of N candidates, within the `[min, max]` of speed and second command where they are drawn.
    pub fn commands(&self, samples: usize, range: [[f64; 2]; 2]) -> Cow<'_, [f32]> {
        match self {
            Self::Given(controls) => Cow::Borrowed(controls),
            Self::Drawn(drawing) => Cow::Owned(drawing.draw(samples, range)),
        }
    }

    /// The numbers that came with the question, and the field that they came in.
    pub fn asked(&self) -> (&'static str, &[f32]) {
        match self {
            Self::Given(controls) => ("controls", controls),
            Self::Drawn(drawing) => ("drawing.nominal", &drawing.nominal),
        }
    }
}

/// The nominal sequence, then Gaussian noise around it: eₖ = ρ eₖ₋₁ + √(1 − ρ²) n, so that the standard deviation is the same at every step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Drawing {
    /// (horizon, 2).
    pub nominal: Vec<f32>,
    /// Standard deviations of speed, m/s, and second command.
    pub sd: [f64; 2],
    /// ρ, 0 to below 1.
    pub correlation: f64,
    /// Seed; candidates depend on nothing else.
    pub seed: u64,
}

impl Drawing {
    /// Checks what does not concern commands: standard deviations and correlation.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the field below `drawing`.
    pub fn check(&self) -> Result<(), EngineError> {
        for (field, sd) in ["speed_sd_m_s", "second_sd"].iter().zip(self.sd) {
            if !(0.0..=1e6).contains(&sd) {
                return Err(EngineError::invalid(format!("drawing.{field}"), format!("is {sd}, allowed are 0 to 1e6")));
            }
        }
        if !(0.0..1.0).contains(&self.correlation) {
            return Err(EngineError::invalid("drawing.correlation", format!("is {}, allowed is 0 to below 1", self.correlation)));
        }
        Ok(())
    }

    /// The candidates, (samples, horizon, 2): the nominal sequence first, the others within the `[min, max]` of speed and second command.
    pub fn draw(&self, samples: usize, range: [[f64; 2]; 2]) -> Vec<f32> {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        let fresh = (1.0 - self.correlation * self.correlation).sqrt();
        let range = range.map(|[low, high]| [low as f32, high as f32]);
        let mut candidates = Vec::with_capacity(samples * self.nominal.len());
        candidates.extend_from_slice(&self.nominal);
        for _ in 1..samples {
            let mut noise = [0.0; 2];
            for (k, nominal) in self.nominal.chunks_exact(2).enumerate() {
                for i in 0..2 {
                    let normal: f64 = StandardNormal.sample(&mut random);
                    noise[i] = if k == 0 { normal } else { self.correlation * noise[i] + fresh * normal };
                    let [low, high] = range[i];
                    candidates.push((nominal[i] + (self.sd[i] * noise[i]) as f32).clamp(low, high));
                }
            }
        }
        candidates
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RANGE: [[f64; 2]; 2] = [[0.0, 8.0], [-0.5, 0.5]];

    #[test]
    fn analytic_noise_has_its_deviation_and_correlation_at_every_step() {
        let [speed, second] = RANGE.map(|[low, high]| 0.5 * (low + high));
        let (samples, horizon) = (4000, 6);
        let nominal: Vec<f32> = (0..horizon).flat_map(|_| [speed as f32, second as f32]).collect();
        let drawing = Drawing { nominal: nominal.clone(), sd: [0.05, 0.01], correlation: 0.8, seed: 7 };
        let drawn = drawing.draw(samples, RANGE);
        assert_eq!(drawn[..2 * horizon], nominal, "the first is the nominal one");
        let at = |n: usize, k: usize, i: usize| f64::from(drawn[(n * horizon + k) * 2 + i]) - [speed, second][i];
        let mean = |value: &dyn Fn(usize) -> f64| (1..samples).map(value).sum::<f64>() / (samples - 1) as f64;
        for (i, sd) in drawing.sd.into_iter().enumerate() {
            for k in 0..horizon {
                let variance = mean(&|n| at(n, k, i).powi(2));
                assert!((variance.sqrt() / sd - 1.0).abs() < 0.05, "step {k}, command {i}");
            }
            let lagged = mean(&|n| at(n, 2, i) * at(n, 4, i)) / (sd * sd);
            assert!((lagged - 0.64).abs() < 0.06, "two steps apart the correlation is squared: {lagged}");
        }
        assert_eq!(drawing.draw(samples, RANGE), drawn, "the seed says all");
        assert_ne!(Drawing { seed: 8, ..drawing.clone() }.draw(2, RANGE), drawing.draw(2, RANGE));
    }

    #[test]
    fn property_candidates_stay_within_the_card() {
        let nominal: Vec<f32> = RANGE.iter().map(|[_, high]| *high as f32).collect();
        let drawn = Drawing { nominal, sd: [100.0, 100.0], correlation: 0.0, seed: 1 }.draw(500, RANGE);
        for pair in drawn.chunks_exact(2) {
            for (value, [low, high]) in pair.iter().zip(RANGE) {
                assert!(*value >= low as f32 && *value <= high as f32);
            }
        }
    }

    #[test]
    fn regress_wrong_drawings_are_refused_with_the_field() {
        let sound = Drawing { sd: [0.1, 0.1], ..Default::default() };
        assert!(sound.check().is_ok());
        for (wrong, field) in [
            (Drawing { sd: [-1.0, 0.0], ..sound.clone() }, "drawing.speed_sd_m_s"),
            (Drawing { sd: [0.0, f64::NAN], ..sound.clone() }, "drawing.second_sd"),
            (Drawing { correlation: 1.0, ..sound }, "drawing.correlation"),
        ] {
            assert_eq!(wrong.check().unwrap_err().field(), field);
        }
    }
}
