//! PNG layers, read row by row so that a damaged file is named with its row, and flipped to south first.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use png::{BitDepth, ColorType};

use crate::error::TerrainError;

/// Kind of image that a layer must be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ImageKind {
    pub(crate) colour: ColorType,
    pub(crate) depth: BitDepth,
    pub(crate) name: &'static str,
}

pub(crate) const GRAY_16: ImageKind = ImageKind { colour: ColorType::Grayscale, depth: BitDepth::Sixteen, name: "16-bit gray" };
pub(crate) const RGB_8: ImageKind = ImageKind { colour: ColorType::Rgb, depth: BitDepth::Eight, name: "8-bit rgb" };
pub(crate) const GRAY_8: ImageKind = ImageKind { colour: ColorType::Grayscale, depth: BitDepth::Eight, name: "8-bit gray" };

/// Reads an image of the given kind and size; bytes row-major with the LAST image row (south) first.
pub(crate) fn read_image(path: &Path, kind: ImageKind, width: usize, height: usize) -> Result<Vec<u8>, TerrainError> {
    let wrong = |reason: String| TerrainError::Image { path: path.to_path_buf(), reason };
    let file = File::open(path).map_err(|source| TerrainError::Read { path: path.to_path_buf(), source })?;
    let mut reader = png::Decoder::new(BufReader::new(file)).read_info().map_err(|error| wrong(format!("not a readable png: {error}")))?;
    let header = reader.info();
    if (header.width as usize, header.height as usize) != (width, height) {
        return Err(wrong(format!("{} x {} pixels, world.json says {width} x {height}", header.width, header.height)));
    }
    if header.color_type != kind.colour || header.bit_depth != kind.depth {
        return Err(wrong(format!("{:?} with {:?} bits per sample, expected {}", header.color_type, header.bit_depth, kind.name)));
    }
    if header.interlaced {
        return Err(wrong("interlaced; save it without interlacing".into()));
    }
    let line = width * kind.colour.samples() * if kind.depth == BitDepth::Sixteen { 2 } else { 1 };
    let mut bytes = vec![0; line * height];
    for row in 0..height {
        match reader.next_row() {
            Ok(Some(pixels)) if pixels.data().len() == line => {
                let to = (height - 1 - row) * line;
                bytes[to..to + line].copy_from_slice(pixels.data());
            }
            Ok(_) => return Err(wrong(format!("ends at row {row} of {height}"))),
            Err(error) => return Err(wrong(format!("damaged at row {row} of {height}: {error}"))),
        }
    }
    reader.finish().map_err(|error| wrong(format!("damaged after the last row: {error}")))?;
    Ok(bytes)
}

/// Reads an 8-bit gray image (region ids of a simulated world), row-major with the south row first.
///
/// # Errors
/// `TerrainError` naming the file and the row when the image is missing, damaged, of another kind or of another size.
pub fn read_gray8(path: &Path, width: usize, height: usize) -> Result<Vec<u8>, TerrainError> {
    read_image(path, GRAY_8, width, height)
}
