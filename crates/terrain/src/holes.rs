//! Holes of the elevation layer: heights from around, and how far those are believed.
//!
//! Local maps made from a lidar always have holes. A height between two known cells is interpolated; where known ground lies on one side alone it goes on
//! level. Nothing beyond the heights around can come out of either: slopes that are carried on would overshoot behind every wall.

use crate::geometry::GridGeometry;

/// Distance from a known cell up to which a filled height is believed, m (chosen: what a wheel bridges or a stone shades; half the width of the widest hole
/// that is believed as a whole).
pub(crate) const BELIEVED_M: f64 = 0.5;

/// A line across a hole counts where its nearer end lies within this, m. Chosen: twice [`BELIEVED_M`], so that slopes over a footprint are those across the
/// hole wherever they are believed; further in, ground ahead and behind says less than what is beside.
const NEAR_M: f64 = 1.0;

/// Part of a cell that forgives a resolution that was rounded, as 0.1 in f32 is.
const SLACK: f64 = 1e-6;

/// No known cell on this side.
const NONE: u32 = u32::MAX;

/// An elevation layer without holes, and what is left of them.
pub(crate) struct Filled {
    /// Heights; those of given cells are as given, m.
    pub(crate) height_m: Vec<f32>,
    /// True where the height was given; `None` when all were.
    pub(crate) given: Option<Vec<bool>>,
    /// True where the height was given or lies within [`BELIEVED_M`] of one that was; `None` when all are.
    pub(crate) known: Option<Vec<bool>>,
}

/// Fills the holes (NaN) of a layer; `None` when nothing is given. A layer without holes stays as it is.
pub(crate) fn fill_holes(geometry: &GridGeometry, mut height_m: Vec<f32>) -> Option<Filled> {
    if !height_m.iter().any(|z| z.is_nan()) {
        return Some(Filled { height_m, given: None, known: None });
    }
    let given: Vec<bool> = height_m.iter().map(|z| !z.is_nan()).collect();
    if !given.contains(&true) {
        return None;
    }
    fill_across(geometry, &given, &mut height_m);
    fill_level(geometry.width, &mut height_m);
    let known = believed(geometry, &given);
    Some(Filled { height_m, given: Some(given), known: known.contains(&false).then_some(known) })
}

/// Fills the holes that lie between two known cells of their row or column; the others stay NaN.
fn fill_across(geometry: &GridGeometry, given: &[bool], height_m: &mut [f32]) {
    let width = geometry.width;
    let near = ((NEAR_M / geometry.resolution_m + SLACK) as u32).max(1);
    // Of each hole in order the row of the known cell in the south and the column of the one in the west; the way back takes them from the end and meets those
    // in the north and east.
    let mut before: Vec<[u32; 2]> = Vec::new();
    let mut south = vec![NONE; width];
    for (row, given) in given.chunks_exact(width).enumerate() {
        let mut west = NONE;
        for (column, (given, south)) in given.iter().zip(&mut south).enumerate() {
            if *given {
                (*south, west) = (row as u32, column as u32);
            } else {
                before.push([*south, west]);
            }
        }
    }
    let mut north = vec![NONE; width];
    for (row, given) in given.chunks_exact(width).enumerate().rev() {
        let mut east = NONE;
        for (column, (given, north)) in given.iter().zip(&mut north).enumerate().rev() {
            if *given {
                (*north, east) = (row as u32, column as u32);
            } else {
                let [south, west] = before.pop().expect("as many holes on the way back; this is a bug");
                let at = row * width + column;
                let lines = [Line::across(at, column, [west, east], 1), Line::across(at, row, [south, *north], width)];
                height_m[at] = between(lines.into_iter().flatten().filter(|line| line.cells[0].min(line.cells[1]) <= near), height_m);
            }
        }
    }
}

/// A hole between two known cells of a row or a column.
struct Line {
    ends: [usize; 2],
    /// How far away they are, cells.
    cells: [u32; 2],
}

impl Line {
    /// The line through cell `at`, the `place`-th of its row or column, whose cells are `stride` apart in the layer; `a` and `b` are the
    /// places of the known cells before and after. `None` with nothing on one side.
    fn across(at: usize, place: usize, [a, b]: [u32; 2], stride: usize) -> Option<Self> {
        (a != NONE && b != NONE).then(|| {
            let cells = [place as u32 - a, b - place as u32];
            Self { ends: [at - cells[0] as usize * stride, at + cells[1] as usize * stride], cells }
        })
    }
}

/// Height at which the second differences along the lines add up to 0, NaN without a line: Laplace's equation with unequal steps (Shortley and Weller 1938),
/// whose solution is a membrane. A plane comes out as it is; of a single hole it is the mean around.
fn between(lines: impl Iterator<Item = Line>, height_m: &[f32]) -> f32 {
    let (mut sum, mut weights) = (0.0, 0.0);
    for Line { ends, cells } in lines {
        let [za, zb] = ends.map(|end| f64::from(height_m[end]));
        let [a, b] = cells.map(f64::from);
        let weight = 1.0 / (a * b);
        sum += weight * (za * b + zb * a) / (a + b);
        weights += weight;
    }
    (sum / weights) as f32
}

/// Lets the heights that are there go on into what is still NaN, ring by ring: each cell takes the mean of the cells beside it of earlier rings.
fn fill_level(width: usize, height_m: &mut [f32]) {
    /// Of a cell of the present or the next ring: no height yet and no hole any more. No given height is infinite.
    const IN_A_RING: f32 = f32::INFINITY;
    let (width, cells) = (width as u32, height_m.len() as u32);
    // The cells west, east, south and north; beyond the border the cell itself, which has no height yet.
    let beside = |at: u32| {
        let column = at % width;
        [
            at - u32::from(column > 0),
            at + u32::from(column + 1 < width),
            at.checked_sub(width).unwrap_or(at),
            if at + width < cells { at + width } else { at },
        ]
    };
    let open = |at: &u32| height_m[*at as usize].is_nan() && beside(*at).iter().any(|next| !height_m[*next as usize].is_nan());
    let mut ring: Vec<u32> = (0..cells).filter(open).collect();
    ring.iter().for_each(|at| height_m[*at as usize] = IN_A_RING);
    let (mut means, mut further) = (Vec::new(), Vec::new());
    while !ring.is_empty() {
        for at in &ring {
            let (mut sum, mut count) = (0.0, 0.0);
            for next in beside(*at) {
                let z = &mut height_m[next as usize];
                if z.is_finite() {
                    (sum, count) = (sum + f64::from(*z), count + 1.0);
                } else if z.is_nan() {
                    *z = IN_A_RING;
                    further.push(next);
                }
            }
            means.push((sum / count) as f32);
        }
        ring.iter().zip(means.drain(..)).for_each(|(at, mean)| height_m[*at as usize] = mean);
        ring.clear();
        std::mem::swap(&mut ring, &mut further);
    }
}

/// True within [`BELIEVED_M`] of a given cell. A disc about each, as one row after the other: a given cell that lies d columns away reaches √(R² - d²) rows.
fn believed(geometry: &GridGeometry, given: &[bool]) -> Vec<bool> {
    let width = geometry.width;
    let radius = BELIEVED_M / geometry.resolution_m;
    let farthest = (radius + SLACK) as usize;
    let rows = |d: usize| (radius.powi(2) - (d as f64).powi(2)).max(0.0).sqrt();
    // Rows that a given cell d columns away covers, its own included; none from further away.
    let cover: Vec<u32> = (0..=farthest).map(|d| (rows(d) + SLACK) as u32 + 1).chain([0]).collect();
    let mut known = given.to_vec();
    let mut away = vec![0; width];
    let mut pass = |row: usize, covered: &mut [u32]| {
        let cells = row * width..(row + 1) * width;
        columns_away(&given[cells.clone()], farthest + 1, &mut away);
        for ((known, covered), away) in known[cells].iter_mut().zip(covered).zip(&away) {
            *covered = covered.saturating_sub(1).max(cover[*away]);
            *known |= *covered > 0;
        }
    };
    let (mut from_south, mut from_north) = (vec![0; width], vec![0; width]);
    (0..geometry.height).for_each(|row| pass(row, &mut from_south));
    (0..geometry.height).rev().for_each(|row| pass(row, &mut from_north));
    known
}

/// How many columns each cell of a row is away from the nearest given one, at most `limit`.
fn columns_away(given: &[bool], limit: usize, away: &mut [usize]) {
    let step = |last: &mut usize, given: bool| {
        *last = if given { 0 } else { (*last + 1).min(limit) };
        *last
    };
    let mut last = limit;
    given.iter().zip(&mut *away).for_each(|(given, away)| *away = step(&mut last, *given));
    last = limit;
    given.iter().zip(away).rev().for_each(|(given, away)| *away = (*away).min(step(&mut last, *given)));
}
