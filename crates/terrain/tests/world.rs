//! Heights, slopes, tiles and patches of maps whose answers are known in closed form.
#![allow(clippy::unwrap_used)]

use nesam_terrain::{GridGeometry, PATCH_PX, PATCH_RESOLUTION_M, Patch, PatchScale, Pose2, TerrainError, WorldMap, sample_patch};

const SIDE: usize = 401;

fn grid() -> GridGeometry {
    GridGeometry { origin_m: [-20.0, -20.0], resolution_m: 0.1, width: SIDE, height: SIDE }
}

fn heights(f: impl Fn(f64, f64) -> f64) -> Vec<f32> {
    let g = grid();
    (0..g.cells()).map(|i| g.to_world(i % SIDE, i / SIDE)).map(|[x, y]| f(x, y) as f32).collect()
}

fn map(f: impl Fn(f64, f64) -> f64) -> WorldMap {
    WorldMap::from_layers("test", 1, grid(), heights(f), None).unwrap()
}

fn patch_at(map: &WorldMap, x_m: f64, y_m: f64, yaw_rad: f64) -> Patch {
    let mut patch = Patch::new();
    sample_patch(map, Pose2 { x_m, y_m, yaw_rad }, &PatchScale::default(), &mut patch);
    patch
}

/// Metres ahead and to the left of the vehicle of a pixel.
fn offset(row: usize, column: usize) -> [f64; 2] {
    [63.5 - row as f64, 63.5 - column as f64].map(|px| px * PATCH_RESOLUTION_M)
}

#[test]
fn analytic_plane_has_its_height_and_slope_everywhere() {
    // Bilinear interpolation and central differences are exact on a plane; what is left is f32 (heights up to 8 m: 5e-7 m).
    let plane = map(|x, y| 1.0 + 0.2 * x - 0.1 * y);
    for (x, y) in [(0.0, 0.0), (3.217, -11.93), (-20.0, -20.0), (20.0, 20.0), (19.99, -19.95)] {
        let ground = plane.ground(x, y).unwrap();
        assert!((ground.height_m - (1.0 + 0.2 * x - 0.1 * y)).abs() < 2e-6);
        assert_eq!(plane.height_m(x, y), Some(ground.height_m));
        assert!((ground.slope_x - 0.2).abs() < 1e-5 && (ground.slope_y + 0.1).abs() < 1e-5, "{ground:?}");
    }
    assert!(plane.ground(20.2, 0.0).is_none() && !plane.contains(20.2, 0.0));
    assert!(plane.height_m(f64::NAN, 0.0).is_none() && plane.height_m(0.0, f64::INFINITY).is_none());
    assert!((plane.nearest_height_m(25.0, 0.0) - 5.0).abs() < 1e-6, "clamped to the border");
}

#[test]
fn analytic_slope_is_smoothed_over_a_footprint() {
    // A step of 0.1 m at x = 0: within the footprint its slope spreads out, beyond it vanishes.
    let step = map(|x, _| if x > 0.0 { 0.1 } else { 0.0 });
    assert!(step.ground(0.5, 0.0).unwrap().slope_x.abs() < 1e-6);
    let at = step.ground(0.0, 0.0).unwrap().slope_x;
    assert!(at > 0.1 && at <= 0.1 / 0.2 + 1e-6, "{at}");
}

#[test]
fn analytic_ramp_ahead_rises_towards_row_zero() {
    let ramp = map(|x, _| 0.1 * x);
    // Facing east the ramp rises ahead, facing west it falls, facing north it rises to the right.
    let east = patch_at(&ramp, 2.0, 1.0, 0.0);
    let west = patch_at(&ramp, 2.0, 1.0, std::f64::consts::PI);
    let north = patch_at(&ramp, 2.0, 1.0, std::f64::consts::FRAC_PI_2);
    for row in 0..PATCH_PX {
        for column in 0..PATCH_PX {
            let [ahead, left] = offset(row, column);
            let at = row * PATCH_PX + column;
            let expect = |rise: f64| (0.1 * rise / 3.0) as f32;
            assert!((east.elevation[at] - expect(ahead)).abs() < 2e-5);
            assert!((west.elevation[at] - expect(-ahead)).abs() < 2e-5);
            assert!((north.elevation[at] - expect(-left)).abs() < 2e-5);
        }
    }
    assert_eq!(east.known_share, 1.0);
}

#[test]
fn analytic_bump_to_the_left_appears_at_low_columns() {
    // A bump 3 m to the left and 1 m ahead of a vehicle that faces 0.6 rad.
    let (yaw, x0, y0) = (0.6f64, 1.0, -2.0);
    let bump = [x0 + 1.0 * yaw.cos() - 3.0 * yaw.sin(), y0 + 1.0 * yaw.sin() + 3.0 * yaw.cos()];
    let hill = map(|x, y| (-((x - bump[0]).powi(2) + (y - bump[1]).powi(2)) / 0.18).exp());
    let patch = patch_at(&hill, x0, y0, yaw);
    let peak = (0..patch.elevation.len()).max_by(|a, b| patch.elevation[*a].total_cmp(&patch.elevation[*b])).unwrap();
    let [ahead, left] = offset(peak / PATCH_PX, peak % PATCH_PX);
    assert!((ahead - 1.0).abs() <= 0.06 && (left - 3.0).abs() <= 0.06, "{ahead} {left}");
    assert!(peak % PATCH_PX < 64 && peak / PATCH_PX < 64);
}

#[test]
fn property_patch_turns_with_the_vehicle() {
    // A world turned about the vehicle together with the vehicle looks the same: bilinear error of this smooth surface is 2e-3 m.
    let surface = |x: f64, y: f64| 0.4 * (0.5 * x).sin() * (0.4 * y).cos() + 0.05 * x;
    let reference = patch_at(&map(surface), 0.0, 0.0, 0.0);
    for yaw in [0.3, 1.9, -2.4, std::f64::consts::FRAC_PI_2] {
        let (s, c) = f64::sin_cos(yaw);
        let turned = map(|x, y| surface(c * x + s * y, -s * x + c * y));
        let patch = patch_at(&turned, 0.0, 0.0, yaw);
        for (a, b) in patch.elevation.iter().zip(&reference.elevation) {
            assert!((a - b).abs() < 1e-3, "yaw {yaw}: {a} {b}");
        }
    }
}

#[test]
fn property_cut_map_agrees_with_the_large_one() {
    // The same ground on a large map and on a map cut so that the patch just touches the border.
    let surface = |x: f64, y: f64| 0.3 * (0.7 * x + 0.3 * y).sin();
    let colour = |i: usize| [(i % SIDE % 256) as u8, (i / SIDE % 256) as u8, (i % 7 * 30) as u8];
    let rgb: Vec<[u8; 3]> = (0..SIDE * SIDE).map(colour).collect();
    let large = WorldMap::from_layers("large", 1, grid(), heights(surface), Some(rgb.clone())).unwrap();
    let (first, side) = (137, 128);
    let geometry = GridGeometry { origin_m: grid().to_world(first, first), width: side, height: side, ..grid() };
    let cells: Vec<usize> = (0..side * side).map(|i| (first + i / side) * SIDE + first + i % side).collect();
    let all = heights(surface);
    let small =
        WorldMap::from_layers("small", 1, geometry, cells.iter().map(|i| all[*i]).collect(), Some(cells.iter().map(|i| rgb[*i]).collect()))
            .unwrap();
    let centre = grid().to_world(first, first).map(|o| o + 6.35);
    let (a, b) = (patch_at(&large, centre[0], centre[1], 0.0), patch_at(&small, centre[0], centre[1], 0.0));
    assert!(a.elevation.iter().zip(&b.elevation).all(|(a, b)| (a - b).abs() < 1e-5));
    assert!(a.semantic.iter().zip(&b.semantic).all(|(a, b)| (a - b).abs() < 1e-3));
    assert_eq!((a.known_share, b.known_share), (1.0, 1.0));
}

#[test]
fn analytic_share_of_known_ground_at_the_border() {
    let flat = map(|_, _| 2.0);
    // Facing east on the eastern border: the half ahead is unknown and takes the border height.
    let patch = patch_at(&flat, 20.0, 0.0, 0.0);
    assert!((patch.known_share - 0.5).abs() < 1e-3, "{}", patch.known_share);
    assert!(patch.elevation.iter().all(|z| z.abs() < 1e-6));
    assert_eq!(patch_at(&flat, 100.0, 0.0, 0.0).known_share, 0.0);
    for pose in [(f64::NAN, 0.0, 0.0), (1e300, -1e300, 1.0), (0.0, 0.0, f64::INFINITY)] {
        let patch = patch_at(&flat, pose.0, pose.1, pose.2);
        assert_eq!(patch.known_share, 0.0, "{pose:?}");
        assert!(patch.elevation.iter().all(|z| z.is_finite()));
    }
}

#[test]
fn analytic_holes_are_none_and_are_filled_in_patches() {
    let mut z = heights(|x, _| if x < 0.0 { -1.0 } else { 1.0 });
    // A hole of 2 m by 2 m around (-5, 0): everything near is at -1 m, and its middle is further than 0.5 m from known ground.
    let g = grid();
    for (i, z) in z.iter_mut().enumerate() {
        let [x, y] = g.to_world(i % SIDE, i / SIDE);
        if (x + 5.0).abs() < 1.0 && y.abs() < 1.0 {
            *z = f32::NAN;
        }
    }
    let map = WorldMap::from_layers("holes", 1, g, z, None).unwrap();
    assert!(map.height_m(-5.0, 0.0).is_none() && map.ground(-5.3, 0.0).is_none());
    assert_eq!((map.height_m(-5.7, 0.0), map.height_m(-6.1, 0.0)), (Some(-1.0), Some(-1.0)));
    assert!(map.contains(-5.0, 0.0));
    let patch = patch_at(&map, -10.0, 0.0, 0.3);
    assert!(patch.known_share < 1.0 && patch.known_share > 0.98, "{}", patch.known_share);
    assert!(patch.elevation.iter().all(|z| z.abs() < 1e-6), "the filled hole is level with its surroundings");
    assert!(map.elevation_m().iter().any(|z| z.is_nan()), "the layer is given back with its hole");

    let none = WorldMap::from_layers("none", 1, g, vec![f32::NAN; g.cells()], None).unwrap_err();
    assert!(none.to_string().contains("no cell is known"), "{none}");
}

#[test]
fn analytic_colours_are_scaled_and_absent_without_semantics() {
    let rgb = vec![[255u8, 0, 191]; SIDE * SIDE];
    let map = WorldMap::from_layers("rgb", 1, grid(), heights(|_, _| 0.0), Some(rgb)).unwrap();
    let patch = patch_at(&map, 0.0, 0.0, 0.7);
    let pixels = PATCH_PX * PATCH_PX;
    for (channel, expect) in [1.0, -1.0, (191.0 - 127.5) / 127.5].into_iter().enumerate() {
        assert!(patch.semantic[channel * pixels..(channel + 1) * pixels].iter().all(|v| (v - expect).abs() < 1e-5));
    }
    // The same patch reused on a map without semantics: no colour is left over.
    let bare = self::map(|_, _| 0.0);
    assert!(map.has_semantics() && !bare.has_semantics());
    let mut reused = patch;
    sample_patch(&bare, Pose2 { x_m: 0.0, y_m: 0.0, yaw_rad: 0.0 }, &PatchScale::default(), &mut reused);
    assert!(reused.semantic.iter().all(|v| *v == 0.0));
}

#[test]
fn analytic_elevation_is_clamped() {
    let steep = map(|x, _| 2.0 * x);
    let patch = patch_at(&steep, 0.0, 0.0, 0.0);
    assert_eq!(patch.elevation[0], 1.0);
    assert_eq!(patch.elevation[PATCH_PX * PATCH_PX - 1], -1.0);
}

#[test]
fn analytic_tile_makes_a_new_version() {
    let flat = map(|_, _| 0.0);
    let raised = flat.with_tile(200, 210, 4, 3, &[0.5; 12], None).unwrap();
    assert_eq!((flat.version(), raised.version()), (1, 2));
    assert_ne!(flat.hash(), raised.hash());
    let [x, y] = grid().to_world(202, 211);
    assert_eq!((flat.height_m(x, y), raised.height_m(x, y)), (Some(0.0), Some(0.5)));
    let back = raised.with_tile(200, 210, 4, 3, &[0.0; 12], None).unwrap();
    assert_eq!((back.version(), back.hash()), (3, flat.hash()), "equal content, equal hash");
    let hole = flat.with_tile(190, 200, 24, 23, &[f32::NAN; 24 * 23], None).unwrap();
    assert!(hole.height_m(x, y).is_none());
    let filled = hole.with_tile(190, 200, 24, 23, &[0.0; 24 * 23], None).unwrap();
    assert_eq!(filled.hash(), flat.hash());
}

#[test]
fn analytic_bad_layers_and_tiles_are_refused() {
    let field = |result: Result<WorldMap, TerrainError>| match result.unwrap_err() {
        TerrainError::Layers { field, .. } => field,
        other => panic!("{other}"),
    };
    let flat = map(|_, _| 0.0);
    assert_eq!(field(flat.with_tile(399, 0, 3, 1, &[0.0; 3], None)), "tile width");
    assert_eq!(field(flat.with_tile(0, usize::MAX, 1, 2, &[0.0; 2], None)), "tile height");
    assert_eq!(field(flat.with_tile(0, 0, 0, 1, &[], None)), "tile width");
    assert_eq!(field(flat.with_tile(0, 0, 2, 2, &[0.0; 3], None)), "tile elevation_m");
    assert_eq!(field(flat.with_tile(0, 0, 1, 1, &[0.0], Some(&[[0, 0, 0]]))), "tile semantic_rgb");
    assert_eq!(field(flat.with_tile(0, 0, 1, 1, &[f32::INFINITY], None)), "elevation_m");
    let last = WorldMap::from_layers("a", u64::MAX, grid(), heights(|_, _| 0.0), None).unwrap();
    assert_eq!(field(last.with_tile(0, 0, 1, 1, &[0.0], None)), "version");
    assert_eq!(field(WorldMap::from_layers("a", 1, grid(), vec![0.0; 5], None)), "elevation_m");
    assert_eq!(field(WorldMap::from_layers("a", 1, grid(), heights(|_, _| 0.0), Some(vec![[0; 3]; 4]))), "semantic_rgb");
    let nan_origin = GridGeometry { origin_m: [0.0, f64::NAN], ..grid() };
    assert_eq!(field(WorldMap::from_layers("a", 1, nan_origin, heights(|_, _| 0.0), None)), "origin_m");
    let mut spike = heights(|_, _| 0.0);
    spike[3 * SIDE + 7] = f32::INFINITY;
    let error = WorldMap::from_layers("a", 1, grid(), spike, None).unwrap_err().to_string();
    assert!(error.contains("row 3, column 7"), "{error}");
}

#[test]
fn property_a_mirrored_map_gives_mirrored_patches() {
    let bumpy = map(|x, y| 0.3 * (0.7 * x).sin() + 0.2 * (0.9 * y + 0.4).cos() + 0.01 * x * y);
    let image = bumpy.mirrored();
    assert_eq!(bumpy.height_m(3.21, -4.5).unwrap(), image.height_m(3.21, 4.5).unwrap());
    let (seen, mirrored) = (patch_at(&bumpy, 1.3, 2.1, 0.4), patch_at(&image, 1.3, -2.1, -0.4));
    // Bilinear look-ups of the same cells in another order: f32 rounding of heights scaled to ±1.
    for row in 0..PATCH_PX {
        for column in 0..PATCH_PX {
            let (a, b) = (seen.elevation[row * PATCH_PX + column], mirrored.elevation[row * PATCH_PX + PATCH_PX - 1 - column]);
            assert!((a - b).abs() < 1e-5, "row {row}, column {column}: {a} and {b}");
        }
    }
    assert_eq!(image.mirrored().hash(), bumpy.hash());
}
