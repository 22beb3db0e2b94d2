//! Dimensions of physical quantities, for formulas that people write.

use core::fmt;

/// Twice the exponents of metre, kilogram and second: halves appear under square roots. Angles have none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dimension([i8; 3]);

/// Names of units with their exponents of m, kg and s.
const UNITS: [(&str, [i8; 3]); 11] = [
    ("m", [1, 0, 0]),
    ("kg", [0, 1, 0]),
    ("s", [0, 0, 1]),
    ("N", [1, 1, -2]),
    ("Pa", [-1, 1, -2]),
    ("J", [2, 1, -2]),
    ("W", [2, 1, -3]),
    ("Hz", [0, 0, -1]),
    ("rad", [0, 0, 0]),
    ("1", [0, 0, 0]),
    ("-", [0, 0, 0]),
];

impl Dimension {
    /// Of a plain number.
    pub const NONE: Self = Self([0; 3]);
    /// kg.
    pub const MASS: Self = Self([0, 2, 0]);
    /// m/s².
    pub const ACCELERATION: Self = Self([2, 0, -4]);
    /// m/s.
    pub const SPEED: Self = Self([2, 0, -2]);
    /// rad/s.
    pub const RATE: Self = Self([0, 0, -2]);
    /// N.
    pub const FORCE: Self = Self([2, 2, -4]);
    /// N m.
    pub const MOMENT: Self = Self([4, 2, -4]);

    /// Reads a unit such as `N s^2/m^2`, `kg/s` or `1/m`: factors separated by blanks or `*`; what follows a `/` up to the next one is divided by.
    ///
    /// # Errors
    /// The part that is no unit, and the units that there are; or that the exponents of a long product are out of range.
    pub fn parse(unit: &str) -> Result<Self, String> {
        let mut sum = Self::NONE;
        for (i, part) in unit.split('/').enumerate() {
            let sign = if i == 0 { 1 } else { -1 };
            let mut factors = part.split([' ', '*']).filter(|f| !f.is_empty()).peekable();
            if factors.peek().is_none() {
                return Err(format!("has the unit `{unit}`, in which something is missing"));
            }
            for factor in factors {
                let (name, exponent) = factor.split_once('^').unwrap_or((factor, "1"));
                let known = UNITS.iter().find(|(known, _)| *known == name);
                let (Some((_, exponents)), Ok(exponent @ -4..=4)) = (known, exponent.parse::<i8>()) else {
                    let names: Vec<&str> = UNITS.iter().map(|(name, _)| *name).collect();
                    return Err(format!(
                        "has the unit `{unit}`, in which `{factor}` is none of {} with an exponent from -4 to 4",
                        names.join(" ")
                    ));
                };
                for (total, e) in sum.0.iter_mut().zip(exponents) {
                    let out_of_range = || format!("has the unit `{unit}`, which is out of range: its exponents go beyond 63");
                    *total = total.checked_add(2 * sign * exponent * e).ok_or_else(out_of_range)?;
                }
            }
        }
        Ok(sum)
    }

    /// Of a product.
    pub fn times(self, other: Self) -> Self {
        Self(core::array::from_fn(|i| self.0[i].saturating_add(other.0[i])))
    }

    /// Of a quotient.
    pub fn over(self, other: Self) -> Self {
        Self(core::array::from_fn(|i| self.0[i].saturating_sub(other.0[i])))
    }

    /// Of a whole power.
    pub fn power(self, exponent: i8) -> Self {
        Self(self.0.map(|e| e.saturating_mul(exponent)))
    }

    /// Of a square root; `None` where the exponents cannot be halved again.
    pub fn root(self) -> Option<Self> {
        self.0.iter().all(|e| e % 2 == 0).then(|| Self(self.0.map(|e| e / 2)))
    }
}

impl fmt::Display for Dimension {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if *self == Self::NONE {
            return f.write_str("a plain number");
        }
        let mut first = true;
        for (e, name) in self.0.iter().zip(["m", "kg", "s"]).filter(|(e, _)| **e != 0) {
            f.write_str(if first { "" } else { " " })?;
            first = false;
            match (e % 2, e / 2) {
                (0, 1) => f.write_str(name)?,
                (0, whole) => write!(f, "{name}^{whole}")?,
                _ => write!(f, "{name}^({e}/2)")?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_units_are_products_of_powers() {
        for (unit, same) in [
            ("N", "kg m/s^2"),
            ("N s^2/m^2", "kg/m"),
            ("N m s/rad", "kg m^2/s"),
            ("Pa m^2", "N"),
            ("1/m", "m^-1"),
            ("W s", "J"),
            ("N/m/s", "N / m s"),
        ] {
            assert_eq!(Dimension::parse(unit), Dimension::parse(same), "{unit} {same}");
        }
        assert_eq!(Dimension::parse("N m"), Ok(Dimension::MOMENT));
        assert_eq!(Dimension::parse("m/s").map(|d| d.power(2).root()), Ok(Some(Dimension::SPEED)));
        assert_eq!(Dimension::FORCE.to_string(), "m kg s^-2");
    }

    /// Sums of doubled exponents that a byte holds are taken, one more factor is an error. `W` has s^-3, in both signs.
    #[test]
    fn regress_units_whose_exponents_overflow_are_refused() {
        let product = |factor: &str, n: usize| vec![factor; n].join(" ");
        // 24 a factor: five make 120, six 144.
        for (factor, sign) in [("W^4", ""), ("W^-4", ""), ("W^4", "1/"), ("W^-4", "1/")] {
            assert!(Dimension::parse(&format!("{sign}{}", product(factor, 5))).is_ok(), "{sign}{factor}");
            let error = Dimension::parse(&format!("{sign}{}", product(factor, 6))).unwrap_err();
            assert!(error.contains("out of range"), "{sign}{factor}: {error}");
        }
    }

    #[test]
    fn property_what_is_no_unit_is_refused_with_its_name() {
        for (unit, word) in [("furlong", "furlong"), ("N//m", "missing"), ("", "missing"), ("m^9", "m^9"), ("m^x", "m^x"), ("N kgf", "kgf")]
        {
            let error = Dimension::parse(unit).unwrap_err();
            assert!(error.contains(word), "{unit}: {error}");
        }
    }
}
