//! Adam (Kingma & Ba 2015) with moments that can be saved, and a bound on the norm of the gradient.

use std::collections::{BTreeMap, HashMap};

use candle_core::{Result, Tensor, Var};
use nesam_model::Weights;

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPS: f32 = 1e-8;

/// Optimiser state.
#[derive(Clone, Debug, Default)]
pub struct Adam {
    first: HashMap<String, Vec<f32>>,
    second: HashMap<String, Vec<f32>>,
    steps: i32,
}

impl Adam {
    /// One update with learning rate `rate`; gradients are scaled so that their joint norm is at most `norm_max`, and weight matrices shrink by the share
    /// `rate` · `decay` (Loshchilov & Hutter 2019). Returns the norm before scaling.
    ///
    /// # Errors
    /// A candle error when a variable cannot be read or set.
    pub fn update(
        &mut self,
        variables: &[(String, Var)],
        gradients: &HashMap<String, Vec<f32>>,
        rate: f64,
        norm_max: f32,
        decay: f32,
    ) -> Result<f32> {
        self.steps += 1;
        // In the order of the names: that of a hash map is another in every run, and so is the last bit of its sum.
        let ordered: BTreeMap<&String, &Vec<f32>> = gradients.iter().collect();
        let norm = ordered.into_values().flatten().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt() as f32;
        if !norm.is_finite() {
            return Ok(norm); // a bad batch must not destroy the weights; the caller reports it
        }
        let shrink = if norm > norm_max { norm_max / norm } else { 1.0 };
        let (correct1, correct2) = (1.0 - BETA1.powi(self.steps), 1.0 - BETA2.powi(self.steps));
        for (name, var) in variables {
            let Some(gradient) = gradients.get(name) else { continue };
            let m = self.first.entry(name.clone()).or_insert_with(|| vec![0.0; gradient.len()]);
            let v = self.second.entry(name.clone()).or_insert_with(|| vec![0.0; gradient.len()]);
            let mut values: Vec<f32> = var.flatten_all()?.to_vec1()?;
            let kept = if name.ends_with(".weight") && !name.contains("norm") { 1.0 - rate as f32 * decay } else { 1.0 };
            for (((value, g), m), v) in values.iter_mut().zip(gradient).zip(m).zip(v) {
                let g = g * shrink;
                *m = BETA1 * *m + (1.0 - BETA1) * g;
                *v = BETA2 * *v + (1.0 - BETA2) * g * g;
                *value = *value * kept - rate as f32 * (*m / correct1) / ((*v / correct2).sqrt() + EPS);
            }
            var.set(&Tensor::from_vec(values, var.dims(), var.device())?)?;
        }
        Ok(norm)
    }

    /// Adds the moments to a set of arrays, for a checkpoint.
    pub fn save(&self, weights: &mut Weights) {
        for (name, m) in &self.first {
            weights.insert(format!("adam.first.{name}"), &[m.len()], m.clone());
            weights.insert(format!("adam.second.{name}"), &[m.len()], self.second[name].clone());
        }
        weights.insert("adam.steps", &[1], vec![self.steps as f32]);
    }

    /// Why moments of a checkpoint after `step` steps are not of a network with these weights.
    pub fn mismatch(&self, weights: &Weights, step: usize) -> Option<String> {
        if usize::try_from(self.steps) != Ok(step) {
            return Some(format!("it is of step {}, state.json of step {step}", self.steps));
        }
        let unpaired =
            self.first.keys().chain(self.second.keys()).find(|name| !(self.first.contains_key(*name) && self.second.contains_key(*name)));
        if let Some(name) = unpaired {
            return Some(format!("of `{name}` one of two moments is missing"));
        }
        let sizes: HashMap<&str, usize> = weights.iter().map(|(name, array)| (name, array.values.len())).collect();
        let other = self.first.iter().chain(&self.second).find(|(name, moments)| sizes.get(name.as_str()) != Some(&moments.len()));
        other.map(|(name, moments)| {
            format!("it has {} moments of `{name}`, the network {}", moments.len(), sizes.get(name.as_str()).unwrap_or(&0))
        })
    }

    /// Takes the moments back out of a checkpoint.
    pub fn load(weights: &Weights) -> Self {
        let mut adam = Self::default();
        for (name, array) in weights.iter() {
            if let Some(name) = name.strip_prefix("adam.first.") {
                adam.first.insert(name.into(), array.values.clone());
            } else if let Some(name) = name.strip_prefix("adam.second.") {
                adam.second.insert(name.into(), array.values.clone());
            } else if name == "adam.steps" {
                adam.steps = array.values.first().map_or(0, |steps| *steps as i32);
            }
        }
        adam
    }
}
