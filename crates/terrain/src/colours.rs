//! The semantic layer: packed colours, and the same without hard borders.

use std::ops::Range;

use crate::geometry::GridGeometry;

/// Standard deviation of the smoothing of borders, m. Chosen: detail finer than the grid of poses that tokens are interpolated between (0.25 m, and 5° are
/// 0.5 m at the edge of a patch) cannot be interpolated; half a cell of the encoders' features.
const SMOOTHING_M: f64 = 0.4;

/// Passes of a running mean that stand for a Gaussian.
const PASSES: usize = 3;

/// Packs a colour as r | g << 8 | b << 16.
pub(crate) fn pack([r, g, b]: [u8; 3]) -> u32 {
    u32::from(r) | u32::from(g) << 8 | u32::from(b) << 16
}

/// The colour that was packed.
pub(crate) fn unpack(packed: u32) -> [u8; 3] {
    let [r, g, b, _] = packed.to_le_bytes();
    [r, g, b]
}

/// Packed colours with their borders smoothed by about a Gaussian of [`SMOOTHING_M`]; at the border of the map the cells that there are count.
pub(crate) fn smoothed(geometry: &GridGeometry, colour: &[u32]) -> Vec<u32> {
    smoothed_rectangle([geometry.width, geometry.height], box_radius(SMOOTHING_M / geometry.resolution_m), |at| colour[at])
}

/// Brings smoothed colours up to date with `colour`, of which a rectangle of cells has changed: what lies further than the smoothing reaches stays.
pub(crate) fn smooth_again(geometry: &GridGeometry, colour: &[u32], columns: Range<usize>, rows: Range<usize>, smooth: &mut [u32]) {
    let radius = box_radius(SMOOTHING_M / geometry.resolution_m);
    let grown = |range: &Range<usize>, by: usize, end: usize| range.start.saturating_sub(by)..(range.end + by).min(end);
    // What changes, and what that is computed from.
    let [changed, seen] = [1, 2].map(|times| {
        let by = times * PASSES * radius;
        [grown(&columns, by, geometry.width), grown(&rows, by, geometry.height)]
    });
    let [width, height] = [seen[0].len(), seen[1].len()];
    let cell = |at: usize| (seen[1].start + at / width) * geometry.width + seen[0].start + at % width;
    let again = smoothed_rectangle([width, height], radius, |at| colour[cell(at)]);
    for row in changed[1].clone() {
        let from = (row - seen[1].start) * width + changed[0].start - seen[0].start;
        let to = row * geometry.width + changed[0].start;
        smooth[to..to + changed[0].len()].copy_from_slice(&again[from..from + changed[0].len()]);
    }
}

/// Smooths a rectangle of colours by means over `radius` cells on either side; at its border the cells that there are count.
fn smoothed_rectangle([width, height]: [usize; 2], radius: usize, colour: impl Fn(usize) -> u32) -> Vec<u32> {
    let cells = 0..width * height;
    if radius == 0 {
        return cells.map(colour).collect();
    }
    let mut channels = [0, 1, 2].map(|channel| cells.clone().map(|at| f32::from(unpack(colour(at))[channel])).collect::<Vec<f32>>());
    let mut line = Vec::new();
    for values in &mut channels {
        for _ in 0..PASSES {
            (0..height).for_each(|row| running_mean(values, row * width, 1, width, radius, &mut line));
            (0..width).for_each(|column| running_mean(values, column, width, height, radius, &mut line));
        }
    }
    let [r, g, b] = &channels;
    r.iter().zip(g).zip(b).map(|((r, g), b)| pack([*r, *g, *b].map(|value| value.round() as u8))).collect()
}

/// Radius r of a mean over 2 r + 1 cells of which [`PASSES`] have the variance of a Gaussian of `deviation` cells: PASSES ((2 r + 1)² - 1) / 12 = deviation².
fn box_radius(deviation: f64) -> usize {
    let width = (12.0 * deviation.powi(2) / PASSES as f64 + 1.0).sqrt();
    ((width - 1.0) / 2.0).round() as usize
}

/// Replaces `count` values, `stride` apart from `first` on, by their means over `radius` neighbours on either side.
fn running_mean(values: &mut [f32], first: usize, stride: usize, count: usize, radius: usize, line: &mut Vec<f32>) {
    line.clear();
    line.extend((0..count).map(|i| values[first + i * stride]));
    // Colours are whole numbers up to 255 before the first pass, and an f32 holds sums of a few of their means to 1e-5: in f64 nothing adds up along a row.
    let mut sum: f64 = line[..radius.min(count)].iter().map(|v| f64::from(*v)).sum();
    for i in 0..count {
        if let Some(entering) = line.get(i + radius) {
            sum += f64::from(*entering);
        }
        if let Some(leaving) = i.checked_sub(radius + 1) {
            sum -= f64::from(line[leaving]);
        }
        let cells = (i + radius + 1).min(count) - i.saturating_sub(radius);
        values[first + i * stride] = (sum / cells as f64) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(side: usize) -> GridGeometry {
        GridGeometry { origin_m: [0.0, 0.0], resolution_m: 0.1, width: side, height: side }
    }

    /// A straight border between two colours: the step becomes the integral of the kernel, so the mean stays, halves meet at the border, and what is a
    /// metre away is as it was.
    #[test]
    fn analytic_a_border_becomes_a_slope_of_the_width_of_the_kernel() {
        let side = 60;
        let colour: Vec<u32> = (0..side * side).map(|i| pack(if i % side < 30 { [200, 40, 0] } else { [100, 80, 0] })).collect();
        let smooth = smoothed(&square(side), &colour);
        let row: Vec<[u8; 3]> = smooth[30 * side..31 * side].iter().map(|p| unpack(*p)).collect();
        assert_eq!(row[..18], [[200, 40, 0]; 18]);
        assert_eq!(row[42..], [[100, 80, 0]; 18]);
        for k in 0..12 {
            assert!(row[29 - k][0].abs_diff(200) == row[30 + k][0].abs_diff(100), "the slope is antisymmetric");
            assert!(row[18 + k][0] >= row[19 + k][0]);
        }
        // Three means of 9 cells: 61 of the 9³ ways lead back to the cell itself, so (1 + 61/729) / 2 of the last cell's kernel lies on its own side.
        assert_eq!(row[29][0], 154, "100 + 100 · 0.542");
    }

    /// Goal: a map that is patched is smoothed as one that is uploaded whole. Method: rectangles of other colours all over a speckled map, at its borders too.
    #[test]
    fn property_a_patch_is_smoothed_as_the_whole() {
        let geometry = GridGeometry { width: 83, height: 71, ..square(0) };
        let speckle = |i: usize, salt: usize| pack([0, 8, 16].map(|shift| ((i * 2_654_435_761 + salt * 40_503) >> shift) as u8));
        let mut colour: Vec<u32> = (0..83 * 71).map(|i| speckle(i, 0)).collect();
        let mut smooth = smoothed(&geometry, &colour);
        for (salt, (columns, rows)) in
            [(0..1, 0..1), (40..47, 30..33), (60..83, 50..71), (0..83, 35..36), (82..83, 0..9)].into_iter().enumerate()
        {
            for row in rows.clone() {
                columns.clone().for_each(|column| colour[row * 83 + column] = speckle(row * 83 + column, salt + 1));
            }
            smooth_again(&geometry, &colour, columns, rows, &mut smooth);
            assert!(smooth == smoothed(&geometry, &colour), "rectangle {salt}");
        }
    }

    #[test]
    fn property_one_colour_stays_and_coarse_maps_stay() {
        let plain = vec![pack([7, 130, 255]); 400];
        assert_eq!(smoothed(&square(20), &plain), plain);
        let coarse = GridGeometry { resolution_m: 1.0, ..square(20) };
        let spots: Vec<u32> = (0..400).map(|i| if i % 7 == 0 { pack([255, 0, 0]) } else { 0 }).collect();
        assert_eq!(smoothed(&coarse, &spots), spots);
        assert_eq!(unpack(pack([1, 2, 3])), [1, 2, 3]);
    }
}
