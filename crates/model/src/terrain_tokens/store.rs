//! Where encoded nodes are kept: tiles of neighbouring poses, found by a hash, read by many threads at once.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};
use std::sync::{PoisonError, RwLock, RwLockReadGuard};

use super::{Node, TerrainToken};

/// Nodes after which the store forgets all it has (0.5 kB each).
pub(super) const NODES_MAX: usize = 400_000;
/// Nodes along each side of a tile, as a power of two.
const SIDE_BITS: u32 = 3;
const SIDE: usize = 1 << SIDE_BITS;

/// Tile of a node.
type Key = (i32, i32, i32);

/// Nodes of one tile, absent ones empty.
#[derive(Debug)]
struct Tile(Vec<Option<Box<TerrainToken>>>);

/// Tiles and how many nodes they hold.
#[derive(Debug, Default)]
struct Tiles {
    tiles: HashMap<Key, Tile, BuildHasherDefault<KeyHasher>>,
    nodes: usize,
}

/// The nodes of one map.
#[derive(Debug, Default)]
pub struct NodeStore(RwLock<Tiles>);

/// A look into the store.
pub struct Reader<'a>(RwLockReadGuard<'a, Tiles>);

/// Multiplies and mixes: keys are small numbers of our own, so no one can make them collide on purpose.
#[derive(Default)]
struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.write_i32(i32::from(*byte)));
    }
    fn write_i32(&mut self, value: i32) {
        self.0 = (self.0.rotate_left(23) ^ u64::from(value as u32)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }
    fn finish(&self) -> u64 {
        self.0 ^ (self.0 >> 32)
    }
}

/// Tile of a node and its place there.
fn place((x, y, heading): Node) -> (Key, usize) {
    let within = |v: i32| v as usize & (SIDE - 1);
    ((x >> SIDE_BITS, y >> SIDE_BITS, heading >> SIDE_BITS), (within(x) * SIDE + within(y)) * SIDE + within(heading))
}

impl NodeStore {
    /// Holds the store for reading.
    pub fn read(&self) -> Reader<'_> {
        // A writer that panics leaves whole nodes behind.
        Reader(self.0.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Adds nodes; forgets all others when there are too many.
    pub fn insert(&self, nodes: impl Iterator<Item = (Node, TerrainToken)>) {
        let mut store = self.0.write().unwrap_or_else(PoisonError::into_inner);
        if store.nodes > NODES_MAX {
            *store = Tiles::default();
        }
        for (node, token) in nodes {
            let (key, at) = place(node);
            let tile = store.tiles.entry(key).or_insert_with(|| Tile(vec![None; SIDE * SIDE * SIDE]));
            let is_new = tile.0[at].replace(Box::new(token)).is_none();
            store.nodes += usize::from(is_new);
        }
    }
}

impl Reader<'_> {
    /// Number of nodes.
    pub fn count(&self) -> usize {
        self.0.nodes
    }

    /// The token of a node, if it is there.
    #[inline]
    pub fn get(&self, node: Node) -> Option<&TerrainToken> {
        let (key, at) = place(node);
        self.0.tiles.get(&key)?.0[at].as_deref()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::terrain_tokens::VALUES;

    #[test]
    fn property_nodes_are_found_where_they_were_put() {
        let store = NodeStore::default();
        let nodes: Vec<Node> =
            (-20i32..20).flat_map(|x: i32| (-3i32..30).map(move |y: i32| (x * 7, y - x, (x * x + y).rem_euclid(72)))).collect();
        let value = |node: &Node| (node.0 * 10_000 + node.1 * 100 + node.2) as f32;
        store.insert(nodes.iter().map(|node| (*node, [value(node); VALUES])));
        let reader = store.read();
        for node in &nodes {
            assert_eq!(reader.get(*node).map(|token| token[5]), Some(value(node)), "{node:?}");
        }
        assert!(reader.get((1, 1, 1)).is_none() && reader.get((-1000, 3, 2)).is_none());
    }
}
