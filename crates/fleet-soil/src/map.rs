//! The map: evidence by cell and colour, this server's and what others told of theirs, fused when somebody begins there.

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
    buffers: f64,
    votes: f64,
    stamp_s: f64,
    revision: u64,
}

/// [`CellEvidence`] in plain numbers, to be told and heard.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EvidenceParts {
    /// Λ, in the coordinates of the correction.
    pub information: [[f64; SOIL_DIM]; SOIL_DIM],
    /// η = Λ m.
    pub vector: [f64; SOIL_DIM],
    /// Buffers that went in, aged to the last one.
    pub buffers: f64,
    /// Votes on whether the correction helps, log odds, aged to the last one.
    pub votes: f64,
    /// Instant of the last increment, s.
    pub stamp_s: f64,
    /// Grows with each increment of the map that it was brought to.
    pub revision: u64,
}

/// Other maps that are remembered at most; beyond, the one with the oldest evidence is forgotten.
const HEARD_MAX: usize = 64;
/// One in so many cells is forgotten at a time, so that a full map is not searched for each increment.
const FORGOTTEN_AT_ONCE: usize = 64;
/// Share of its weight below which evidence of another map is not taken any more.
const FADED: f64 = 1e-3;
/// What rounding may make of Λ, as a share of its largest entry: a difference of two entries that should be equal, a diagonal below 0.
const ROUNDING_MAX: f64 = 1e-6;

/// Evidence by cell.
type Cells = BTreeMap<CellKey, CellEvidence>;

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

/// Evidence of the fleet: brought to this map, and heard of other maps. Each part belongs to the map that it was brought to and is replaced, never added, when
/// that one tells a later revision: hearing something twice, late, or by way of a third map changes nothing.
#[derive(Clone, Debug)]
pub struct FleetSoilMap {
    settings: FleetSoilSettings,
    own: Cells,
    /// Increments so far.
    revision: u64,
    /// What was brought to other maps, by their names.
    heard: BTreeMap<String, Cells>,
    /// Instant of the newest evidence that was forgotten for want of space, s: what is told from before is not taken again.
    forgotten_s: f64,
}

impl CellEvidence {
    /// Evidence that somebody told.
    ///
    /// # Errors
    /// `FleetSoilError::Evidence` when a number is not finite, or Λ has a negative diagonal or no symmetry beyond what rounding makes.
    pub fn from_parts(parts: &EvidenceParts) -> Result<Self, FleetSoilError> {
        let EvidenceParts { information, vector, buffers, votes, stamp_s, revision } = *parts;
        let matrix = Matrix::from_fn(|r, c| information[r][c]);
        let numbers = matrix.iter().copied().chain(vector).chain([buffers, votes, stamp_s]);
        let refused = |reason: &str| Err(FleetSoilError::Evidence { reason: reason.into() });
        if numbers.into_iter().any(|v| !v.is_finite()) {
            return refused("a number is not finite");
        }
        let rounding = ROUNDING_MAX * matrix.amax();
        if buffers < 0.0 || (0..SOIL_DIM).any(|i| matrix[(i, i)] < -rounding) {
            return refused("its buffers or the diagonal of its information are negative");
        }
        if (matrix - matrix.transpose()).amax() > rounding {
            return refused("its information is not symmetric");
        }
        Ok(Self { information: matrix, vector: Vector::from(vector), buffers, votes, stamp_s, revision })
    }

    /// The same in plain numbers.
    pub fn parts(&self) -> EvidenceParts {
        EvidenceParts {
            information: core::array::from_fn(|r| core::array::from_fn(|c| self.information[(r, c)])),
            vector: core::array::from_fn(|i| self.vector[i]),
            buffers: self.buffers,
            votes: self.votes,
            stamp_s: self.stamp_s,
            revision: self.revision,
        }
    }

    /// Instant of the last increment, s.
    pub fn stamp_s(&self) -> f64 {
        self.stamp_s
    }

    /// Share of its weight that is left at an instant.
    fn aged(&self, now_s: f64, half_life_s: f64) -> f64 {
        (-(now_s - self.stamp_s).max(0.0) / half_life_s).exp2()
    }

    /// This and other evidence of the same ground, as of the later of the two.
    fn with(&self, other: &Self, half_life_s: f64) -> Self {
        let stamp_s = self.stamp_s.max(other.stamp_s);
        let (a, b) = (self.aged(stamp_s, half_life_s), other.aged(stamp_s, half_life_s));
        Self {
            information: self.information * a + other.information * b,
            vector: self.vector * a + other.vector * b,
            buffers: self.buffers * a + other.buffers * b,
            votes: self.votes * a + other.votes * b,
            stamp_s,
            revision: self.revision.max(other.revision),
        }
    }
}

impl FleetSoilMap {
    /// A map without evidence.
    ///
    /// # Errors
    /// As [`FleetSoilSettings::check`].
    pub fn new(settings: FleetSoilSettings) -> Result<Self, FleetSoilError> {
        settings.check()?;
        Ok(Self { settings, own: Cells::new(), revision: 0, heard: BTreeMap::new(), forgotten_s: f64::NEG_INFINITY })
    }

    /// Settings.
    pub fn settings(&self) -> &FleetSoilSettings {
        &self.settings
    }

    /// All that is known of each cell, whoever it was brought to, in the order of the keys.
    pub fn cells(&self) -> BTreeMap<&CellKey, CellEvidence> {
        let mut all: BTreeMap<&CellKey, CellEvidence> = self.own.iter().map(|(key, evidence)| (key, *evidence)).collect();
        for (key, evidence) in self.heard.values().flatten() {
            all.entry(key).and_modify(|sum| *sum = sum.with(evidence, self.settings.half_life_s)).or_insert(*evidence);
        }
        all
    }

    /// All that is known of one cell.
    pub fn cell(&self, key: &CellKey) -> Option<CellEvidence> {
        let own = self.own.get(key).copied();
        let heard = self.heard.values().filter_map(|cells| cells.get(key));
        heard.fold(own, |sum, evidence| Some(sum.map_or(*evidence, |sum| sum.with(evidence, self.settings.half_life_s))))
    }

    /// What was brought to this map itself, of one cell.
    pub fn own_cell(&self, key: &CellKey) -> Option<&CellEvidence> {
        self.own.get(key)
    }

    /// What was brought to this map (`None`) and to each of the others that it has heard of.
    pub fn by_map(&self) -> impl Iterator<Item = (Option<&str>, &BTreeMap<CellKey, CellEvidence>)> {
        core::iter::once((None, &self.own)).chain(self.heard.iter().map(|(name, cells)| (Some(name.as_str()), cells)))
    }

    /// Adds what a buffer has brought at an instant, s of any clock that only goes forward.
    pub fn add(&mut self, key: CellKey, increment: &Increment, now_s: f64) {
        self.revision += 1;
        let brought = CellEvidence {
            information: increment.matrix,
            vector: increment.vector,
            buffers: 1.0,
            votes: increment.vote,
            stamp_s: now_s,
            revision: self.revision,
        };
        let half_life_s = self.settings.half_life_s;
        self.own.entry(key).and_modify(|cell| *cell = cell.with(&brought, half_life_s)).or_insert(brought);
        self.limit();
    }

    /// Takes what another map tells of a cell, brought to the map `of`. Returns whether it was news: what has faded, is no later than what was heard before, or
    /// is older than all that there is space for, is not.
    pub fn hear(&mut self, of: &str, key: CellKey, evidence: &CellEvidence, now_s: f64) -> bool {
        let faded = evidence.aged(now_s, self.settings.half_life_s) < FADED;
        let known = self.heard.get(of).and_then(|cells| cells.get(&key));
        if faded || evidence.stamp_s <= self.forgotten_s || known.is_some_and(|known| known.revision >= evidence.revision) {
            return false;
        }
        self.heard.entry(of.into()).or_default().insert(key.clone(), *evidence);
        self.limit();
        if self.heard.len() > HEARD_MAX {
            let newest = |cells: &Cells| cells.values().map(CellEvidence::stamp_s).fold(f64::NEG_INFINITY, f64::max);
            let oldest = self.heard.iter().min_by(|a, b| newest(a.1).total_cmp(&newest(b.1))).map(|(name, _)| name.clone());
            oldest.and_then(|name| self.heard.remove(&name));
        }
        self.heard.get(of).is_some_and(|cells| cells.contains_key(&key))
    }

    /// Forgets the oldest evidence beyond the number of cells, whoever it was brought to.
    fn limit(&mut self) {
        let most = self.settings.cells_max;
        if self.own.len() + self.heard.values().map(Cells::len).sum::<usize>() <= most {
            return;
        }
        let all = || core::iter::once(&self.own).chain(self.heard.values()).flat_map(Cells::values).map(CellEvidence::stamp_s);
        let mut stamps_s: Vec<f64> = all().collect();
        let surplus = stamps_s.len() - (most - most / FORGOTTEN_AT_ONCE);
        let (_, &mut newest_s, _) = stamps_s.select_nth_unstable_by(surplus - 1, f64::total_cmp);
        // Of those of the same instant as many as there is no space for.
        let mut of_then = surplus - all().filter(|stamp_s| *stamp_s < newest_s).count();
        let mut is_kept = |_: &CellKey, evidence: &mut CellEvidence| {
            let goes = evidence.stamp_s < newest_s || (evidence.stamp_s == newest_s && of_then > 0);
            of_then -= usize::from(goes && evidence.stamp_s == newest_s);
            !goes
        };
        self.own.retain(&mut is_kept);
        self.heard.values_mut().for_each(|cells| cells.retain(&mut is_kept));
        self.heard.retain(|_, cells| !cells.is_empty());
        self.forgotten_s = self.forgotten_s.max(newest_s);
    }

    /// What a vehicle that begins at a position knows: P₀ around Δθ = 0, and the evidence of this map, each cell weighted by 2^(-age / half-life) e^(-distance / reach) of
    /// the cell's middle and e^(-(difference of colour / reach)²). The covariance gets the process noise on top and no variance above that of P₀. `None` without evidence, or when the sum is no belief.
    pub fn prior(&self, at: &CellKey, position_m: [f64; 2], prior_sd: &[f64; SOIL_DIM], now_s: f64) -> Option<FleetPrior> {
        let FleetSoilSettings { cell_m, half_life_s, reach_m, colour_reach, process_share, .. } = self.settings;
        let mut information = Matrix::from_diagonal(&Vector::from_fn(|i, _| prior_sd[i].powi(-2)));
        let (mut vector, mut buffers, mut votes) = (Vector::zeros(), 0.0, 0.0);
        let of_map =
            CellKey { colour: [0; 3], cell: [i32::MIN; 2], ..at.clone() }..=CellKey { colour: [255; 3], cell: [i32::MAX; 2], ..at.clone() };
        let of_map = self.by_map().flat_map(|(_, cells)| cells.range(of_map.clone()));
        for (key, evidence) in of_map {
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
        assert_eq!(small.cells().keys().map(|key| key.cell[0]).collect::<Vec<_>>(), [6, 7, 8]);
        assert!(Increment::between(&belief(0.0, -1.0), &belief(0.0, 1.0), 0.0).is_err());
        assert!(FleetSoilMap::new(FleetSoilSettings { cell_m: 0.0, ..FleetSoilSettings::default() }).is_err());
    }

    #[test]
    fn property_the_limit_holds_for_all_maps_together_and_what_was_forgotten_is_no_news() {
        let increment = update((0.0, 1.0), 2.0, 0.5).1;
        let mut map = FleetSoilMap::new(FleetSoilSettings { cells_max: 128, ..FleetSoilSettings::default() }).unwrap();
        let mut others = [0, 1].map(|_| exact());
        for i in 0..100 {
            map.add(key(i), &increment, 3.0 * f64::from(i));
            others.iter_mut().enumerate().for_each(|(o, other)| other.add(key(i), &increment, 3.0 * f64::from(i) + o as f64 + 1.0));
        }
        let mut held = |names: [&str; 2]| -> usize {
            let news = others.iter().zip(names).map(|(other, name)| tell(other, name, &mut map, "m", 300.0)).sum();
            let cells = map.by_map().map(|(_, cells)| cells.len()).sum::<usize>();
            assert!((126..=128).contains(&cells), "{cells}");
            // The newest 126 of three times 100, so a good 40 of each.
            assert!(map.by_map().all(|(_, cells)| cells.len() >= 41 && cells.values().all(|cell| cell.stamp_s() >= 170.0)));
            news
        };
        assert!(held(["a", "b"]) > 80);
        assert_eq!(held(["a", "b"]), 0, "what was forgotten is not heard again and again");
    }

    #[test]
    fn analytic_evidence_of_one_instant_is_not_forgotten_altogether() {
        let mut map = FleetSoilMap::new(FleetSoilSettings { cells_max: 3, ..FleetSoilSettings::default() }).unwrap();
        (0..5).for_each(|i| map.add(key(i), &update((0.0, 1.0), 2.0, 0.5).1, 7.0));
        assert_eq!(map.cells().len(), 3);
    }

    /// What one map tells another: everything it knows.
    fn tell(from: &FleetSoilMap, name: &str, to: &mut FleetSoilMap, to_name: &str, now_s: f64) -> usize {
        let told: Vec<(String, CellKey, CellEvidence)> = from
            .by_map()
            .flat_map(|(of, cells)| cells.iter().map(move |(key, evidence)| (of.unwrap_or(name).to_owned(), key.clone(), *evidence)))
            .collect();
        told.iter().filter(|(of, key, evidence)| of != to_name && to.hear(of, key.clone(), evidence, now_s)).count()
    }

    #[test]
    fn property_maps_that_tell_each_other_know_what_one_map_would() {
        let increments: Vec<Increment> = (0..12).map(|i| update((0.1 * f64::from(i), 1.0), (f64::from(i) * 1.7).sin(), 0.5).1).collect();
        let settings = FleetSoilSettings { half_life_s: 50.0, ..FleetSoilSettings::default() };
        let mut one = FleetSoilMap::new(settings).unwrap();
        let mut maps = [0; 3].map(|_| FleetSoilMap::new(settings).unwrap());
        let names = ["a", "b", "c"];
        for (i, increment) in increments.iter().enumerate() {
            let (cell, now_s) = (key(i as i32 % 2), i as f64);
            one.add(cell.clone(), increment, now_s);
            maps[i % 3].add(cell, increment, now_s);
            // Each tells its neighbour only: what is brought to `a` reaches `c` by way of `b`, and comes back to `a` from there.
            let (from, to) = (i % 3, (i + 1) % 3);
            let (teller, mut hearer) = (maps[from].clone(), maps[to].clone());
            tell(&teller, names[from], &mut hearer, names[to], now_s);
            maps[to] = hearer;
        }
        for round in 0..2 {
            for (from, to) in [(0, 1), (1, 2), (2, 0), (0, 1)] {
                let (teller, mut hearer) = (maps[from].clone(), maps[to].clone());
                let news = tell(&teller, names[from], &mut hearer, names[to], 12.0);
                assert!(round == 0 || news == 0, "nothing is news a second time");
                maps[to] = hearer;
            }
        }
        let expected = one.prior(&key(0), [5.0, 5.0], &SD, 20.0).unwrap();
        for map in &maps {
            let prior = map.prior(&key(0), [5.0, 5.0], &SD, 20.0).unwrap();
            assert!((prior.belief.delta[2] - expected.belief.delta[2]).abs() < 1e-12);
            assert!((prior.belief.covariance[2][2] - expected.belief.covariance[2][2]).abs() < 1e-12);
            assert!((prior.buffers - expected.buffers).abs() < 1e-12 && (prior.votes - expected.votes).abs() < 1e-12);
            for (key, evidence) in map.cells() {
                let whole = one.cell(key).unwrap();
                assert!((evidence.buffers - whole.buffers).abs() < 1e-9 && evidence.stamp_s() == whole.stamp_s());
                assert_eq!(map.cell(key), Some(evidence));
            }
        }
    }

    #[test]
    fn property_old_news_garbage_and_strangers_without_end_change_nothing() {
        let mut teller = exact();
        teller.add(key(0), &update((0.0, 1.0), 2.0, 0.5).1, 0.0);
        let early = *teller.own_cell(&key(0)).unwrap();
        teller.add(key(0), &update((0.0, 1.0), 1.0, 0.5).1, 1.0);
        let late = *teller.own_cell(&key(0)).unwrap();
        let mut map = FleetSoilMap::new(FleetSoilSettings { half_life_s: 100.0, ..FleetSoilSettings::default() }).unwrap();
        assert!(map.hear("a", key(0), &late, 1.0));
        assert!(!map.hear("a", key(0), &early, 1.0), "an older revision that comes late");
        assert_eq!(map.cell(&key(0)), Some(late));
        assert!(!map.hear("b", key(1), &early, 1e5), "evidence that has faded");
        assert_eq!(CellEvidence::from_parts(&late.parts()), Ok(late));
        let with = |change: fn(&mut EvidenceParts)| {
            let mut parts = late.parts();
            change(&mut parts);
            CellEvidence::from_parts(&parts)
        };
        assert!(with(|parts| parts.vector[3] = f64::NAN).is_err());
        assert!(with(|parts| parts.information[1][4] = 7.0).is_err());
        assert!(with(|parts| parts.information[2][2] = -1.0).is_err());
        assert!(with(|parts| parts.information[3][3] = -1.0).is_err());
        assert!(with(|parts| parts.information[3][3] = -1e-14).is_ok(), "a sum of differences is rounded");
        assert!(with(|parts| parts.buffers = -1.0).is_err());
        for i in 0..200 {
            let parts = EvidenceParts { stamp_s: f64::from(i), ..late.parts() };
            map.hear(&format!("stranger {i}"), key(0), &CellEvidence::from_parts(&parts).unwrap(), f64::from(i));
        }
        assert_eq!(map.by_map().count(), 1 + HEARD_MAX);
        assert!(map.by_map().all(|(name, _)| name != Some("stranger 0")), "the oldest is forgotten");
    }
}
