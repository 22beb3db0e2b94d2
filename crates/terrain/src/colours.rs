//! The semantic layer: packed colours, and the same without hard borders.

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
    let GridGeometry { width, height, resolution_m, .. } = *geometry;
    let radius = box_radius(SMOOTHING_M / resolution_m);
    if radius == 0 {
        return colour.to_vec();
    }
    let mut channels = [0, 1, 2].map(|channel| colour.iter().map(|&packed| f32::from(unpack(packed)[channel])).collect::<Vec<f32>>());
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
