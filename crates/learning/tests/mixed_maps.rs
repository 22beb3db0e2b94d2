//! Goal: a drive without terrain features takes none from the drives that share its batch. Method: a window with features and one without, over the same
//! ground, alone and side by side: loss and gradients of the batch are the means of those alone.

mod common;

use std::collections::HashMap;
use std::sync::Arc;

use candle_core::Device;
use common::{drive, encoded, hills, lively_weights, measured_scales, single_cells, truck};
use nesam_learning::batch::Window;
use nesam_learning::{Objective, TrainingSet};
use nesam_model::Variant;
use nesam_model::reference::Network;
use nesam_physics::step::StepModel;

#[test]
fn regress_a_drive_without_features_leaves_those_of_its_batch_their_terrain() {
    let mut unseen = drive(Some(&hills()), 60);
    // Errors to learn from: the same drive, measured on a slower vehicle.
    unseen.states.iter_mut().for_each(|state| state.velocity_m_s[0] *= 0.9);
    let scales = measured_scales(&unseen);
    let weights = lively_weights(&scales);
    let seen = encoded(unseen.clone(), &weights, &scales);
    assert!(seen.has_features() && !unseen.has_features());
    let model = Arc::new(StepModel::new(&truck(), scales.dt_s, scales.substeps));
    let set = TrainingSet { train: vec![&seen, &unseen], validation: vec![], scales: &scales, model, pooling: single_cells() };
    let network = Network::from_weights(&weights, &Device::Cpu).expect("all arrays are there");
    let objective = Objective { variant: Variant::Full, sustained: 0.0, soil_prior: 0.0 };
    let of = |windows: &[Window<'_>]| -> (f32, HashMap<String, Vec<f32>>) {
        set.gradients(&network, windows, 8, 6, objective).expect("the loss is differentiable")
    };
    let window = |drive, start| Window { drive, start, dropout: None };
    let (of_seen, of_unseen) = (of(&[window(&seen, 12)]), of(&[window(&unseen, 30)]));
    let blind = of(&[window(&unseen, 12)]);
    assert_ne!(of_seen.0, blind.0, "what is seen of the terrain matters");
    assert!(of_seen.1.contains_key("token.context.weight") && !of_unseen.1.contains_key("token.context.weight"));
    for windows in [[window(&seen, 12), window(&unseen, 30)], [window(&unseen, 30), window(&seen, 12)]] {
        let (loss, gradients) = of(&windows);
        let mean = (of_seen.0 + of_unseen.0) / 2.0;
        // Sums of another batch: the last bits may differ.
        assert!((loss - mean).abs() < 1e-5 * mean, "{loss} {mean}");
        for name in ["token.context.weight", "soil.out.bias", "soil.out.weight", "residual.bias", "token.bias"] {
            let found = gradients.get(name).unwrap_or_else(|| panic!("no gradient of {name}"));
            let part = |of: &HashMap<String, Vec<f32>>, i: usize| of.get(name).map_or(0.0, |values| values[i]);
            let expected: Vec<f32> = (0..found.len()).map(|i| (part(&of_seen.1, i) + part(&of_unseen.1, i)) / 2.0).collect();
            let largest = expected.iter().fold(0.0, |largest: f32, g| largest.max(g.abs()));
            assert!(largest > 0.0, "{name}");
            for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
                assert!((found - expected).abs() < 1e-4 * largest, "{name}[{i}]: {found} {expected}");
            }
        }
    }
}
