//! Formulas that people write: parsed once, checked for dimensions, computed with any scalar.

use super::unit::Dimension;
use crate::scalar::Real;

/// Values on the stack at once, and operations of a formula, at most.
const STACK: usize = 12;
const OPERATIONS_MAX: usize = 96;
/// Smoothing of `abs` and `sign`, in the unit of the argument.
const SMOOTH: f64 = 1e-3;
/// Added under a root, in the unit of the argument, so that it has a slope at 0.
const ROOT_FLOOR: f64 = 1e-12;

/// One step of a stack machine.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Operation {
    Constant(f64),
    Variable(usize),
    Add,
    Subtract,
    Multiply,
    Divide,
    Negate,
    Power(u8),
    Root,
    Absolute,
    Sine,
    Cosine,
    Tanh,
    Smaller,
    Larger,
}

/// A formula.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Program(Vec<Operation>);

/// A name that a formula may use.
#[derive(Clone, Debug)]
pub struct Name {
    /// As written.
    pub name: String,
    /// Its dimension.
    pub dimension: Dimension,
    /// Its value, if it is a parameter; otherwise it is a variable.
    pub value: Option<f64>,
}

impl Program {
    /// Reads a formula of numbers, names, + - * / ^, parentheses and abs, sqrt, sin, cos, tanh, min, max. `names` are the variables in the order of
    /// [`Program::at`] and the parameters; the result has the dimension `wanted`.
    ///
    /// # Errors
    /// What is wrong and where: an unknown name, a missing parenthesis, dimensions that do not fit, a formula that is too long.
    pub fn parse(text: &str, names: &[Name], wanted: Dimension) -> Result<Self, String> {
        let mut parser = Parser { text, at: 0, names, operations: Vec::new(), depth: 0 };
        let dimension = parser.sum()?;
        parser.blanks();
        if parser.at < text.len() {
            return Err(parser.wrong("does not belong there"));
        }
        if dimension != wanted {
            return Err(format!("`{text}` has the dimension of {dimension}, not of {wanted}"));
        }
        Ok(Self(parser.operations))
    }

    /// Whether there is a formula.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Value at these variables.
    pub fn at<T: Real>(&self, variables: &[T]) -> T {
        let mut stack = [T::lit(0.0); STACK];
        let mut top = 0_usize;
        for operation in &self.0 {
            let (a, b) = (stack[top.saturating_sub(2)], stack[top.saturating_sub(1)]);
            let (taken, value) = match *operation {
                Operation::Constant(value) => (0, T::lit(value)),
                Operation::Variable(i) => (0, variables[i]),
                Operation::Add => (2, a + b),
                Operation::Subtract => (2, a - b),
                Operation::Multiply => (2, a * b),
                Operation::Divide => (2, a / b),
                Operation::Smaller => (2, a.min(b)),
                Operation::Larger => (2, a.max(b)),
                Operation::Negate => (1, -b),
                Operation::Power(n) => (1, (1..n).fold(b, |power, _| power * b)),
                Operation::Root => (1, (b.max(T::lit(0.0)) + T::lit(ROOT_FLOOR)).sqrt()),
                Operation::Absolute => (1, b.abs_smooth(SMOOTH)),
                Operation::Sine => (1, b.sin_cos().0),
                Operation::Cosine => (1, b.sin_cos().1),
                Operation::Tanh => (1, tanh(b)),
            };
            top -= taken;
            stack[top] = value;
            top += 1;
        }
        stack[0]
    }
}

/// Hyperbolic tangent, without overflow.
fn tanh<T: Real>(x: T) -> T {
    let e = (x.max(T::lit(-15.0)).min(T::lit(15.0)) * T::lit(2.0)).exp();
    (e - T::lit(1.0)) / (e + T::lit(1.0))
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
    names: &'a [Name],
    operations: Vec<Operation>,
    depth: usize,
}

impl Parser<'_> {
    fn rest(&self) -> &str {
        &self.text[self.at..]
    }

    fn blanks(&mut self) {
        self.at += self.rest().len() - self.rest().trim_start().len();
    }

    /// Takes a sign if it is next.
    fn takes(&mut self, sign: char) -> bool {
        self.blanks();
        let taken = self.rest().starts_with(sign);
        self.at += if taken { sign.len_utf8() } else { 0 };
        taken
    }

    fn wrong(&self, what: &str) -> String {
        let rest = self.rest();
        let here = if rest.is_empty() { "the end".to_string() } else { format!("`{}`", rest.chars().take(12).collect::<String>()) };
        format!("in `{}`, {here} {what}", self.text)
    }

    fn put(&mut self, operation: Operation) -> Result<(), String> {
        self.operations.push(operation);
        let longest = self.operations.len() <= OPERATIONS_MAX && self.stack() <= STACK;
        if longest { Ok(()) } else { Err(format!("`{}` is too long or too deep", self.text)) }
    }

    /// Values that the operations so far leave on the stack.
    fn stack(&self) -> usize {
        self.operations.iter().fold(0, |held, operation| match operation {
            Operation::Constant(_) | Operation::Variable(_) => held + 1,
            Operation::Add | Operation::Subtract | Operation::Multiply | Operation::Divide | Operation::Smaller | Operation::Larger => {
                held - 1
            }
            _ => held,
        })
    }

    fn same(&self, what: &str, a: Dimension, b: Dimension) -> Result<Dimension, String> {
        if a == b { Ok(a) } else { Err(format!("in `{}`, {what} is of {a} and of {b}", self.text)) }
    }

    /// Goes one level deeper, unless that is too deep.
    fn deeper(&mut self) -> Result<(), String> {
        self.depth += 1;
        if self.depth <= STACK { Ok(()) } else { Err(format!("`{}` is too long or too deep", self.text)) }
    }

    fn sum(&mut self) -> Result<Dimension, String> {
        self.deeper()?;
        let dimension = self.terms()?;
        self.depth -= 1;
        Ok(dimension)
    }

    fn terms(&mut self) -> Result<Dimension, String> {
        let mut dimension = self.product()?;
        loop {
            let operation = if self.takes('+') {
                Operation::Add
            } else if self.takes('-') {
                Operation::Subtract
            } else {
                return Ok(dimension);
            };
            let other = self.product()?;
            dimension = self.same("a sum", dimension, other)?;
            self.put(operation)?;
        }
    }

    fn product(&mut self) -> Result<Dimension, String> {
        let mut dimension = self.signed()?;
        loop {
            if self.takes('*') {
                dimension = dimension.times(self.signed()?);
                self.put(Operation::Multiply)?;
            } else if self.takes('/') {
                dimension = dimension.over(self.signed()?);
                self.put(Operation::Divide)?;
            } else {
                return Ok(dimension);
            }
        }
    }

    fn signed(&mut self) -> Result<Dimension, String> {
        if self.takes('-') {
            self.deeper()?;
            let dimension = self.signed()?;
            self.depth -= 1;
            self.put(Operation::Negate)?;
            return Ok(dimension);
        }
        let dimension = self.value()?;
        if !self.takes('^') {
            return Ok(dimension);
        }
        self.blanks();
        let digits: String = self.rest().chars().take_while(char::is_ascii_digit).collect();
        match digits.parse::<u8>() {
            Ok(exponent @ 1..=6) => {
                self.at += digits.len();
                self.put(Operation::Power(exponent))?;
                Ok(dimension.power(exponent as i8))
            }
            _ => Err(self.wrong("should be an exponent from 1 to 6")),
        }
    }

    fn value(&mut self) -> Result<Dimension, String> {
        if self.takes('(') {
            return self.inside();
        }
        self.blanks();
        let first = self.rest().chars().next();
        if first.is_some_and(|c| c.is_ascii_digit() || c == '.') {
            return self.number();
        }
        let word: String = self.rest().chars().take_while(|c| c.is_ascii_alphanumeric() || *c == '_').collect();
        if word.is_empty() {
            return Err(self.wrong("should be a number, a name or a parenthesis"));
        }
        if self.rest()[word.len()..].trim_start().starts_with('(') {
            return self.call(&word);
        }
        let Some(i) = self.names.iter().position(|n| n.name == word) else {
            let names: Vec<&str> = self.names.iter().map(|n| n.name.as_str()).collect();
            return Err(self.wrong(&format!("is not known; there are {}", names.join(", "))));
        };
        self.at += word.len();
        self.put(self.names[i].value.map_or(Operation::Variable(i), Operation::Constant))?;
        Ok(self.names[i].dimension)
    }

    /// What follows a parenthesis, and its end.
    fn inside(&mut self) -> Result<Dimension, String> {
        let dimension = self.sum()?;
        if self.takes(')') { Ok(dimension) } else { Err(self.wrong("should be a closing parenthesis")) }
    }

    fn number(&mut self) -> Result<Dimension, String> {
        let rest = self.rest();
        let mut length = rest.chars().take_while(|c| c.is_ascii_digit() || *c == '.').count();
        if let Some(exponent) = rest[length..].strip_prefix(['e', 'E']) {
            let sign = usize::from(exponent.starts_with(['+', '-']));
            let digits = exponent[sign..].chars().take_while(char::is_ascii_digit).count();
            length += if digits > 0 { 1 + sign + digits } else { 0 };
        }
        let value = rest[..length].parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(|| self.wrong("is not a number"))?;
        self.at += length;
        self.put(Operation::Constant(value))?;
        Ok(Dimension::NONE)
    }

    fn call(&mut self, function: &str) -> Result<Dimension, String> {
        let begin = self.at;
        let operation = match function {
            "abs" => Operation::Absolute,
            "sqrt" => Operation::Root,
            "sin" => Operation::Sine,
            "cos" => Operation::Cosine,
            "tanh" => Operation::Tanh,
            "min" => Operation::Smaller,
            "max" => Operation::Larger,
            _ => return Err(self.wrong("is not a function; there are abs, sqrt, sin, cos, tanh, min, max")),
        };
        self.at += function.len();
        self.takes('(');
        let dimension = if matches!(operation, Operation::Smaller | Operation::Larger) {
            let first = self.sum()?;
            if !self.takes(',') {
                return Err(self.wrong("should be a comma and a second argument"));
            }
            let second = self.inside()?;
            self.same(function, first, second)?
        } else {
            self.inside()?
        };
        self.put(operation)?;
        match operation {
            Operation::Root => dimension.root().ok_or_else(|| format!("in `{}`, the root of {dimension} has no dimension", self.text)),
            Operation::Sine | Operation::Cosine | Operation::Tanh if dimension != Dimension::NONE => {
                self.at = begin;
                Err(self.wrong(&format!("is taken of {dimension}, not of a plain number")))
            }
            _ => Ok(dimension),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scalar::Dual;

    fn names() -> Vec<Name> {
        let name = |name: &str, dimension, value| Name { name: name.into(), dimension, value };
        vec![name("v", Dimension::SPEED, None), name("a", Dimension::NONE, None), name("k", Dimension::FORCE, Some(30.0))]
    }

    fn parse(text: &str, wanted: Dimension) -> Result<Program, String> {
        Program::parse(text, &names(), wanted)
    }

    #[test]
    fn analytic_formulas_have_the_values_of_arithmetic() {
        let (v, a) = (2.0_f64, 0.3_f64);
        for (text, value) in [
            ("1 + 2 * 3 - 4 / 8", 6.5),
            ("-a^2", -a * a),
            ("(1 + a) * -(2 - a)", -(1.3 * 1.7)),
            ("2e-1 * .5 + 1.5E2", 150.1),
            ("sin(a) + cos(a) * tanh(4 * a)", a.sin() + a.cos() * (4.0 * a).tanh()),
            ("min(a, 0.1) + max(a, 0.5) + sqrt(4 * a^2)", 0.1 + 0.5 + 0.6),
            ("v / (v + v) + abs(-a)", 0.5 + (a * a + 1e-6).sqrt()),
            ("8 / 4 / 2 - 1 - 1", -1.0),
        ] {
            let found = parse(text, Dimension::NONE).unwrap().at(&[v, a]);
            assert!((found - value).abs() < 1e-12, "{text}: {found}, not {value}");
        }
        assert_eq!(parse("-k * v * abs(v) / v^2", Dimension::FORCE).unwrap().at(&[4.0_f64, 0.0]).round(), -30.0);
        assert!(tanh(400.0_f64) <= 1.0 && tanh(-400.0_f64) >= -1.0);
    }

    #[test]
    fn analytic_duals_carry_derivatives_through_formulas() {
        let a = 0.4_f64;
        let found =
            parse("a^3 * tanh(a) + sqrt(1 + a)", Dimension::NONE).unwrap().at(&[Dual::<f64, 1>::constant(0.0), Dual::variable(a, 0)]);
        let slope = 3.0 * a * a * a.tanh() + a.powi(3) * (1.0 - a.tanh().powi(2)) + 0.5 / (1.0 + a).sqrt();
        assert!((found.eps[0] - slope).abs() < 1e-12, "{found:?} {slope}");
    }

    #[test]
    fn property_roots_have_finite_derivatives_at_and_below_nothing() {
        for (text, a) in [("sqrt(a)", 0.0), ("sqrt(a^2)", 0.0), ("sqrt(abs(a) * v / v)", 0.0), ("sqrt(a)", -0.5)] {
            let found = parse(text, Dimension::NONE).unwrap().at(&[Dual::<f64, 1>::constant(2.0), Dual::variable(a, 0)]);
            assert!(found.re.abs() < 0.1 && found.eps[0].is_finite(), "{text}: {found:?}");
        }
    }

    #[test]
    fn property_wrong_formulas_are_refused_with_what_and_where() {
        let deep = format!("{}1{}", "(".repeat(40), ")".repeat(40));
        let minus = format!("{}1", "-".repeat(5000));
        let long = "1+".repeat(400) + "1";
        for (text, word) in [
            ("v + a", "a sum"),
            ("k", "not of a plain number"),
            ("speed", "there are v, a, k"),
            ("1 +", "the end"),
            ("(1", "closing parenthesis"),
            ("1 2", "does not belong there"),
            ("exp(1)", "not a function"),
            ("sin(v)", "not of a plain number"),
            ("sqrt(v) * 1", "dimension"),
            ("sqrt(sqrt(v))", "no dimension"),
            ("min(1)", "comma"),
            ("a^0", "exponent"),
            ("a^x", "exponent"),
            ("1.2.3", "not a number"),
            ("", "the end"),
            ("é", "number, a name"),
            (&deep, "too deep"),
            (&minus, "too deep"),
            (&long, "too long"),
        ] {
            let error = parse(text, Dimension::NONE).unwrap_err();
            assert!(error.contains(word), "{text}: {error}");
        }
    }
}
