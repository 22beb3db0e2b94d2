//! The map: evidence by cell and colour, fused when somebody begins there.

use std::collections::BTreeMap;

use nesam_physics::SOIL_DIM;

use crate::cell::CellKey;
use crate::error::FleetSoilError;
use crate::increment::{Increment, Matrix, SoilBelief, Vector};
use crate::settings::FleetSoilSettings;

/// Evidence of one cell and colour, as of its last increment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CellEvidence {
    information: Matrix,
    vector: Vector,
    /// Buffers that went in, aged like the information.
    buffers: f64,
    /// Votes on whether the correction helps, log odds, aged.
    votes: f64,
    /// Instant of the last increment, s.
    stamp_s: f64,
}

/// What a vehicle starts from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FleetPrior {
    /// The filter's own prior with the evidence of the fleet.
    pub belief: SoilBelief,
    /// Buffers that speak, weighted by age and distance; 0 = none.
    pub buffers: f64,
    /// What they say on whether the correction helps, log odds.
    pub votes: f64,
}

/// Evidence of the fleet.
#[derive(Clone, Debug)]
pub struct FleetSoilMap {
    settings: FleetSoilSettings,
    cells: BTreeMap<CellKey, CellEvidence>,
}

impl CellEvidence {
    /// Share of its weight that is left at an instant.
    fn aged(&self, now_s: f64, half_life_s: f64) -> f64 {
        (-(now_s - self.stamp_s).max(0.0) / half_life_s).exp2()
    }

    /// Λ, row-major, in the coordinates of the correction.
    pub fn information(&self) -> [[f64; SOIL_DIM]; SOIL_DIM] {
        core::array::from_fn(|r| core::array::from_fn(|c| self.information[(r, c)]))
    }

    /// η = Λ m.
    pub fn vector(&self) -> [f64; SOIL_DIM] {
        core::array::from_fn(|i| self.vector[i])
    }

    /// Buffers that went in, aged to the last one.
    pub fn buffers(&self) -> f64 {
        self.buffers
    }

    /// Instant of the last increment, s.
    pub fn stamp_s(&self) -> f64 {
        self.stamp_s
    }
}

impl FleetSoilMap {
    /// A map without evidence.
    ///
    /// # Errors
    /// As [`FleetSoilSettings::check`].
    pub fn new(settings: FleetSoilSettings) -> Result<Self, FleetSoilError> {
        settings.check()?;
        Ok(Self { settings, cells: BTreeMap::new() })
    }

    /// Settings.
    pub fn settings(&self) -> &FleetSoilSettings {
        &self.settings
    }

    /// All cells, in the order of their keys.
    pub fn cells(&self) -> impl Iterator<Item = (&CellKey, &CellEvidence)> {
        self.cells.iter()
    }

    /// The evidence of one cell.
    pub fn cell(&self, key: &CellKey) -> Option<&CellEvidence> {
        self.cells.get(key)
    }

    /// Adds what a buffer has brought at an instant, s of any clock that only goes forward.
    pub fn add(&mut self, key: CellKey, increment: &Increment, now_s: f64) {
        let half_life_s = self.settings.half_life_s;
        let none = CellEvidence { information: Matrix::zeros(), vector: Vector::zeros(), buffers: 0.0, votes: 0.0, stamp_s: now_s };
        let cell = self.cells.entry(key).or_insert(none);
        let aged = cell.aged(now_s, half_life_s);
        *cell = CellEvidence {
            information: cell.information * aged + increment.matrix,
            vector: cell.vector * aged + increment.vector,
            buffers: cell.buffers * aged + 1.0,
            votes: cell.votes * aged + increment.vote,
            stamp_s: cell.stamp_s.max(now_s),
        };
        if self.cells.len() > self.settings.cells_max {
            let oldest = self.cells.iter().min_by(|a, b| a.1.stamp_s.total_cmp(&b.1.stamp_s)).map(|(key, _)| key.clone());
            oldest.and_then(|key| self.cells.remove(&key));
        }
    }

    /// What a vehicle that begins at a position knows: P₀ around Δθ = 0, and the evidence of this map, each cell weighted by 2^(-age / half-life) e^(-distance / reach) of
    /// the cell's middle and e^(-(difference of colour / reach)²). The covariance gets the process noise on top and no variance above that of P₀. `None` without evidence, or when the sum is no belief.
    pub fn prior(&self, at: &CellKey, position_m: [f64; 2], prior_sd: &[f64; SOIL_DIM], now_s: f64) -> Option<FleetPrior> {
        let FleetSoilSettings { cell_m, half_life_s, reach_m, colour_reach, process_share, .. } = self.settings;
        let mut information = Matrix::from_diagonal(&Vector::from_fn(|i, _| prior_sd[i].powi(-2)));
        let (mut vector, mut buffers, mut votes) = (Vector::zeros(), 0.0, 0.0);
        let of_map =
            CellKey { colour: [0; 3], cell: [i32::MIN; 2], ..at.clone() }..=CellKey { colour: [255; 3], cell: [i32::MAX; 2], ..at.clone() };
        for (key, evidence) in self.cells.range(of_map) {
            let [x, y] = key.centre_m(cell_m);
            // Inside its own cell a vehicle is as near as can be told.
            let distance_m = ((x - position_m[0]).hypot(y - position_m[1]) - 0.5 * cell_m).max(0.0);
            let difference: f64 = (0..3).map(|i| (f64::from(key.colour[i]) - f64::from(at.colour[i])).powi(2)).sum();
            let alike = (-difference / colour_reach.powi(2)).exp();
            let weight = evidence.aged(now_s, half_life_s) * (-distance_m / reach_m).exp() * alike;
            information += evidence.information * weight;
            vector += evidence.vector * weight;
            buffers += evidence.buffers * weight;
            votes += evidence.votes * weight;
        }
        if buffers < f64::MIN_POSITIVE {
            return None;
        }
        let symmetric = (information + information.transpose()) * 0.5;
        let covariance = symmetric.cholesky()?.inverse();
        let delta = covariance * vector;
        let noisy = covariance + Matrix::from_diagonal(&Vector::from_fn(|i, _| (process_share * prior_sd[i]).powi(2)));
        let scale = Vector::from_fn(|i, _| (prior_sd[i] / noisy[(i, i)].sqrt()).min(1.0));
        let finite = noisy.iter().chain(delta.iter()).all(|v| v.is_finite());
        finite.then(|| FleetPrior {
            belief: SoilBelief {
                delta: core::array::from_fn(|i| delta[i]),
                covariance: core::array::from_fn(|r| core::array::from_fn(|c| noisy[(r, c)] * scale[r] * scale[c])),
            },
            buffers,
            votes,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SD: [f64; SOIL_DIM] = [1.0; SOIL_DIM];

    fn belief(mean: f64, variance: f64) -> SoilBelief {
        let mut covariance = [[0.0; SOIL_DIM]; SOIL_DIM];
        (0..SOIL_DIM).for_each(|i| covariance[i][i] = if i == 2 { variance } else { 1.0 });
        let mut delta = [0.0; SOIL_DIM];
        delta[2] = mean;
        SoilBelief { delta, covariance }
    }

    /// An update of parameter 2 by a measurement y with variance r from a prior.
    fn update(prior: (f64, f64), y: f64, r: f64) -> ((f64, f64), Increment) {
        let (m, p) = prior;
        let posterior = (m + p / (p + r) * (y - m), p * r / (p + r));
        (posterior, Increment::between(&belief(m, p), &belief(posterior.0, posterior.1), 0.5).unwrap())
    }

    fn key(x: i32) -> CellKey {
        CellKey { map: "w".into(), colour: [8, 8, 8], cell: [x, 0] }
    }

    fn exact() -> FleetSoilMap {
        FleetSoilMap::new(FleetSoilSettings { process_share: 0.0, half_life_s: 1e12, ..FleetSoilSettings::default() }).unwrap()
    }

    #[test]
    fn analytic_two_vehicles_fuse_as_one_that_measured_both() {
        let mut map = exact();
        map.add(key(0), &update((0.0, 1.0), 2.0, 0.5).1, 0.0);
        let prior = map.prior(&key(0), [5.0, 5.0], &SD, 0.0).unwrap();
        // Λ = 1 + 2, η = 4.
        assert!((prior.belief.delta[2] - 4.0 / 3.0).abs() < 1e-12 && (prior.belief.covariance[2][2] - 1.0 / 3.0).abs() < 1e-12);
        // The second vehicle starts from that and measures; only what it measured itself is added.
        let (_, own) = update((prior.belief.delta[2], prior.belief.covariance[2][2]), -1.0, 0.25);
        map.add(key(0), &own, 0.0);
        let both = map.prior(&key(0), [5.0, 5.0], &SD, 0.0).unwrap();
        assert!((both.belief.delta[2] - (4.0 - 4.0) / 7.0).abs() < 1e-12 && (both.belief.covariance[2][2] - 1.0 / 7.0).abs() < 1e-12);
        assert_eq!((both.buffers, both.votes), (2.0, 1.0));
    }

    #[test]
    fn property_what_came_out_of_the_map_never_comes_back() {
        // A hundred vehicles that take the prior and learn nothing leave it as it is.
        let mut map = exact();
        map.add(key(0), &update((0.0, 1.0), 2.0, 0.5).1, 0.0);
        let first = map.prior(&key(0), [5.0, 5.0], &SD, 0.0).unwrap();
        for _ in 0..100 {
            let prior = map.prior(&key(0), [5.0, 5.0], &SD, 0.0).unwrap();
            map.add(key(0), &Increment::between(&prior.belief, &prior.belief, 0.0).unwrap(), 0.0);
        }
        let last = map.prior(&key(0), [5.0, 5.0], &SD, 0.0).unwrap();
        assert!((first.belief.delta[2] - last.belief.delta[2]).abs() < 1e-12);
        assert!((first.belief.covariance[2][2] - last.belief.covariance[2][2]).abs() < 1e-12);
    }

    #[test]
    fn analytic_evidence_halves_with_time_and_fades_with_distance() {
        let mut map =
            FleetSoilMap::new(FleetSoilSettings { process_share: 0.0, half_life_s: 100.0, ..FleetSoilSettings::default() }).unwrap();
        map.add(key(0), &update((0.0, 1.0), 2.0, 0.5).1, 0.0);
        let variance = |position_m, now_s| map.prior(&key(0), position_m, &SD, now_s).unwrap().belief.covariance[2][2];
        assert!((variance([5.0, 5.0], 100.0) - 1.0 / 2.0).abs() < 1e-12, "Λ = 1 + 2 / 2");
        let e = (-1.0_f64).exp();
        assert!((variance([30.0, 5.0], 0.0) - 1.0 / (1.0 + 2.0 * e)).abs() < 1e-12, "20 m beyond the edge of the cell");
        let other = CellKey { colour: [40, 8, 8], ..key(0) };
        let unlike = map.prior(&other, [5.0, 5.0], &SD, 0.0).unwrap().belief.covariance[2][2];
        assert!((unlike - 1.0 / (1.0 + 2.0 * e)).abs() < 1e-12, "32 levels of red");
        assert!(map.prior(&CellKey { map: "v".into(), ..key(0) }, [5.0, 5.0], &SD, 0.0).is_none(), "another map");
    }

    #[test]
    fn property_the_order_of_increments_does_not_matter_and_limits_hold() {
        let increments: Vec<Increment> = (0..20).map(|i| update((0.1 * f64::from(i), 1.0), (f64::from(i) * 1.7).sin(), 0.5).1).collect();
        let fused = |order: &mut dyn Iterator<Item = usize>| {
            let mut map = exact();
            order.for_each(|i| map.add(key(0), &increments[i], 0.0));
            map.prior(&key(0), [0.0, 0.0], &SD, 0.0).unwrap().belief.delta[2]
        };
        assert!((fused(&mut (0..20)) - fused(&mut (0..20).rev())).abs() < 1e-12);
        let mut small = FleetSoilMap::new(FleetSoilSettings { cells_max: 3, ..FleetSoilSettings::default() }).unwrap();
        (0..9).for_each(|i| small.add(key(i), &increments[0], f64::from(i)));
        assert_eq!(small.cells().map(|(key, _)| key.cell[0]).collect::<Vec<_>>(), [6, 7, 8]);
        assert!(Increment::between(&belief(0.0, -1.0), &belief(0.0, 1.0), 0.0).is_err());
        assert!(FleetSoilMap::new(FleetSoilSettings { cell_m: 0.0, ..FleetSoilSettings::default() }).is_err());
    }
}
