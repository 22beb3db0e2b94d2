//! What the network's products are rounded to in rollouts.

use crate::fused::{Order, Path};

/// Numbers that the network multiplies in rollouts; sums and physics are in f32 always. The soil filter, Jacobians, the measured history and the terrain do not
/// know it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// As they are.
    #[default]
    F32,
    /// Rounded to bf16, summed in this order. On every processor the same bits; on one with the instructions for it faster than f32, on others slower.
    Bf16(Order),
}

impl Precision {
    /// All of them.
    const ALL: [Self; 3] = [Self::F32, Self::Bf16(Order::Tiles), Self::Bf16(Order::Pairs)];

    /// bf16 in the order for which this processor has the faster instructions; `None` where it has none at all.
    pub fn bf16_here() -> Option<Self> {
        Path::for_bf16().first().map(|(order, _)| Self::Bf16(*order))
    }

    /// The fastest path of this processor for it.
    pub fn fastest_path(self) -> Path {
        let of_order = |order| Path::for_bf16().into_iter().find(|(own, _)| *own == order).map(|(_, path)| path);
        match self {
            Self::F32 => None,
            Self::Bf16(order) => of_order(order),
        }
        .unwrap_or_else(Path::fastest)
    }

    /// The order of its sums, where it has one of its own.
    pub(crate) fn order(self) -> Option<Order> {
        match self {
            Self::F32 => None,
            Self::Bf16(order) => Some(order),
        }
    }

    /// Name in files: `f32`, `bf16-tiles`, `bf16-pairs`.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::Bf16(Order::Tiles) => "bf16-tiles",
            Self::Bf16(Order::Pairs) => "bf16-pairs",
        }
    }

    /// The one of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|precision| precision.as_str() == name)
    }
}
