//! Linearisations of rollouts.

use std::sync::Arc;

use nesam_physics::VehicleState;
use rayon::prelude::*;

use super::{LogClock, Predictor, control, pose, raw_soil, validate};
use crate::ModelError;
use crate::ground::{GroundSource, wheel_points};
use crate::interruption::Interruption;
use crate::rollout::RolloutQuery;
use crate::soil_coordinates::from_raw;
use crate::tangent::{ExactTransformer, Linearisation, Plane, Scenery, TangentRollout};

impl Predictor {
    /// The samples of a query in f64, ready for their derivatives; one linearisation for each. The states differ from those of
    /// [`Predictor::rollout`] by the rounding of f32.
    ///
    /// # Errors
    /// As [`Predictor::rollout`].
    pub fn linearise<'a>(&'a self, query: &RolloutQuery<'a>) -> Result<Vec<Linearisation<'a>>, ModelError> {
        self.linearise_with(query, Interruption::default())
    }

    /// The same with what may happen meanwhile: rollouts and their derivatives that are abandoned end within a step and are of no use.
    ///
    /// # Errors
    /// As [`Predictor::linearise`].
    pub fn linearise_with<'a>(
        &'a self,
        query: &RolloutQuery<'a>,
        interruption: Interruption<'a>,
    ) -> Result<Vec<Linearisation<'a>>, ModelError> {
        validate(query)?;
        let scales = &self.bundle.normalization;
        let tokens = query.map.map(|map| self.tokens_of(map));
        let clock = LogClock { start_s: query.start_time_s, dt_s: scales.dt_s };
        let (history, start) = self.true_motion(query.history, &query.start, clock);
        let history = history.as_ref();
        let ground = GroundSource::new(query.map.map(Arc::as_ref), self.physics.at(clock.start_s), &start);
        let variant = self.form_of(query);
        if !variant.remembers() {
            let reason = format!("a model of the form `{}` has no derivatives", variant.as_str());
            return Err(ModelError::Query { field: "variant", reason });
        }
        let first = control(query, 0, 0);
        let shared = Arc::new(TangentRollout {
            physics: &self.physics,
            clock,
            network: ExactTransformer(&self.network),
            scales,
            variant,
            prefix: self.prefix(variant, history, &ground, tokens.as_deref(), clock),
            coordinates: query.soil_correction.coordinates,
            wheels: query.wheels,
            interruption,
            previous: history.last().map(|step| step.state),
            observed_share: self.observed_share(history, clock),
            actuators: (!history.is_empty()).then(|| self.actuators(history, &start, &first, clock)),
        });
        let look = |k: usize, state: &VehicleState<f64>| {
            let model = self.physics.at(clock.after(k));
            let token = self.terrain(tokens.as_deref(), &[pose(state)])[0];
            let plane = |x: f64, y: f64| Plane::at(&ground, &model.vehicle().effects.map, x, y);
            Scenery {
                token,
                prior: from_raw(&raw_soil(&token)),
                reference: plane(state.position_m[0], state.position_m[1]),
                wheels: wheel_points(model, state).map(|[x, y]| plane(x, y)),
            }
        };
        let of_sample = |n: usize| {
            let controls = (0..query.horizon).map(|k| control(query, n, k)).collect();
            Linearisation::roll_out(Arc::clone(&shared), &query.start, controls, query.soil_correction.delta, look)
        };
        Ok((0..query.samples).into_par_iter().map(of_sample).collect())
    }
}
