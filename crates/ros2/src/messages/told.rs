//! What is told to machines: arrays of numbers with the names of their axes, and diagnostics.

use crate::cdr::Writer;

/// An axis of an array.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Dimension {
    /// What lies along it.
    pub label: String,
    /// Number of entries.
    pub size: u32,
}

/// std_msgs/msg/Float64MultiArray, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Float64MultiArray {
    /// Axes, the slowest first.
    pub dimensions: Vec<Dimension>,
    /// As many numbers as the product of the sizes.
    pub data: Vec<f64>,
}

impl Float64MultiArray {
    /// The message.
    pub fn write(&self) -> Vec<u8> {
        let mut cdr = Writer::new();
        cdr.length(self.dimensions.len());
        for (i, dimension) in self.dimensions.iter().enumerate() {
            cdr.text(&dimension.label);
            cdr.u32(dimension.size);
            // The stride of an axis counts the entries of it and of all below.
            cdr.u32(self.dimensions[i..].iter().map(|below| below.size).product());
        }
        cdr.u32(0); // data_offset
        cdr.length(self.data.len());
        self.data.iter().for_each(|value| cdr.f64(*value));
        cdr.finish()
    }
}

/// How well something is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Level {
    /// Well.
    Ok = 0,
    /// Works, and somebody should look.
    Warn = 1,
    /// Does not work.
    Error = 2,
    /// Nothing was heard of it for a while.
    Stale = 3,
}

/// diagnostic_msgs/msg/DiagnosticStatus.
#[derive(Clone, Debug, PartialEq)]
pub struct DiagnosticStatus {
    /// How well it is.
    pub level: Level,
    /// What this is about.
    pub name: String,
    /// One sentence.
    pub message: String,
    /// Which device.
    pub hardware_id: String,
    /// Keys and values.
    pub values: Vec<(String, String)>,
}

/// diagnostic_msgs/msg/DiagnosticArray.
#[derive(Clone, Debug, PartialEq)]
pub struct DiagnosticArray {
    /// Instant, ns since 1970.
    pub stamp_ns: i64,
    /// One for each thing.
    pub status: Vec<DiagnosticStatus>,
}

impl DiagnosticArray {
    /// The message.
    pub fn write(&self) -> Vec<u8> {
        let mut cdr = Writer::new();
        cdr.header(self.stamp_ns);
        cdr.length(self.status.len());
        for status in &self.status {
            cdr.u8(status.level as u8);
            [&status.name, &status.message, &status.hardware_id].into_iter().for_each(|text| cdr.text(text));
            cdr.length(status.values.len());
            for (key, value) in &status.values {
                cdr.text(key);
                cdr.text(value);
            }
        }
        cdr.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_bytes_of_an_array() {
        // Goal: lengths, strides and padding as the standard says. Method: the bytes of a 1 x 2 array, counted by hand.
        let axis = |label: &str, size| Dimension { label: label.into(), size };
        let message = Float64MultiArray { dimensions: vec![axis("row", 1), axis("c", 2)], data: vec![0.5, -2.0] }.write();
        let mut expected = vec![0, 1, 0, 0, 2, 0, 0, 0];
        expected.extend([4, 0, 0, 0, b'r', b'o', b'w', 0, 1, 0, 0, 0, 2, 0, 0, 0]);
        // Two bytes of text leave two of padding before the size.
        expected.extend([2, 0, 0, 0, b'c', 0, 0, 0, 2, 0, 0, 0, 2, 0, 0, 0]);
        expected.extend([0, 0, 0, 0, 2, 0, 0, 0]);
        // The 44 bytes so far leave four of padding before doubles.
        expected.extend([0; 4]);
        expected.extend([0.5f64.to_le_bytes(), (-2.0f64).to_le_bytes()].concat());
        assert_eq!(message, expected);
    }

    #[test]
    fn analytic_bytes_of_a_diagnosis() {
        let status = DiagnosticStatus {
            level: Level::Warn,
            name: "n".into(),
            message: "a\0b".into(),
            hardware_id: String::new(),
            values: vec![("k".into(), "v".into())],
        };
        let message = DiagnosticArray { stamp_ns: -1, status: vec![status] }.write();
        // One nanosecond before 1970 is second -1 and 999 999 999 ns.
        let mut expected = vec![0, 1, 0, 0, 255, 255, 255, 255];
        expected.extend(999_999_999u32.to_le_bytes());
        expected.extend([1, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]);
        // The zero inside of the message is left out.
        expected.extend([2, 0, 0, 0, b'n', 0, 0, 0, 3, 0, 0, 0, b'a', b'b', 0, 0]);
        expected.extend([1, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]);
        expected.extend([2, 0, 0, 0, b'k', 0, 0, 0, 2, 0, 0, 0, b'v', 0]);
        assert_eq!(message, expected);
    }
}
