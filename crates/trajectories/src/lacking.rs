//! What the drives of a set lack and are loaded without.

use std::collections::BTreeMap;

/// How many drives of a set lack something, by what it is.
#[derive(Default)]
pub(crate) struct Lacking {
    /// By channels of the pose that are taken for zero.
    pub(crate) channels: BTreeMap<String, usize>,
    /// By worlds that the index names and the root does not have.
    pub(crate) worlds: BTreeMap<String, usize>,
    /// By worlds that are there without an elevation image.
    pub(crate) elevations: BTreeMap<String, usize>,
    /// By the name of a split that is neither train nor test.
    pub(crate) splits: BTreeMap<String, usize>,
    /// Drives without a row in the index that the set has.
    pub(crate) not_in_index: usize,
}

/// Worlds that are told one by one; of more than these only how many there are is told.
const WORLDS_EACH: usize = 4;

impl Lacking {
    /// What the set itself does not have.
    pub(crate) fn sentences(&self, set: &str) -> Vec<String> {
        let channels = self.channels.iter().map(|(names, count)| {
            format!("set `{set}`: {names} not measured in {count} drives: taken for zero, on level ground without a map, and not scored")
        });
        let elevations =
            self.elevations.iter().map(|(world, count)| without_map(set, &format!("world `{world}` has no elevation image"), *count));
        let splits = self.splits.iter().map(|(name, count)| {
            format!("set `{set}`: split `{name}` of {count} drives is neither train nor test: only --split all reads them")
        });
        channels.chain(elevations).chain(splits).collect()
    }

    /// Where index, samples and worlds do not belong together.
    pub(crate) fn contradictions(&self, set: &str) -> Vec<String> {
        let each = |(world, count): (&String, &usize)| without_map(set, &format!("the data root has no world `{world}`"), *count);
        let mut told: Vec<String> = if self.worlds.len() <= WORLDS_EACH {
            self.worlds.iter().map(each).collect()
        } else {
            let named = self.worlds.keys().take(WORLDS_EACH).map(|world| format!("`{world}`")).collect::<Vec<_>>().join(", ");
            let more = self.worlds.len() - WORLDS_EACH;
            vec![without_map(set, &format!("the data root has no world {named} and {more} more"), self.worlds.values().sum())]
        };
        if self.not_in_index > 0 {
            told.push(format!("set `{set}`: {} drives are not in the index: no map, no split", self.not_in_index));
        }
        told
    }
}

fn without_map(set: &str, why: &str, drives: usize) -> String {
    format!("set `{set}`: {why}: {drives} drives have no map, and are predicted on level ground of the default soil")
}
