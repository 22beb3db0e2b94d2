//! The catalogue, and what an engineer wrote down beside it, as hypotheses: parameters with priors, a linear form for the first look and the effect itself for
//! the refit.

pub(crate) mod bend;

use std::sync::{LazyLock, Mutex, PoisonError};

use nesam_physics::effects::{Effect, Layer, Scaling, Written};

/// A parameter that a refit estimates.
#[derive(Clone, Copy, Debug)]
pub struct Free {
    /// Index among the effect's parameters.
    pub parameter: usize,
    /// Prior mean.
    pub mean: f64,
    /// Prior standard deviation: wide, it only keeps unobservable directions in place.
    pub sd: f64,
    /// Step of the finite differences.
    pub step: f64,
}

/// One line of the catalogue: what a hypothesis is and which sizes it is tried at first.
#[derive(Clone, Debug)]
struct Line {
    /// The effect; its values are replaced.
    effect: Effect,
    /// Distinguishes hypotheses of one id, such as the wheel that drags.
    variant: &'static str,
    /// Parameters of the effects whose shares span the hypothesis near zero.
    columns: Vec<Vec<f64>>,
    free: Vec<Free>,
    /// How each free parameter grows with the share of its column.
    scalings: Vec<Scaling>,
    /// Whether columns are differentiated forward from zero, because the effect has no counterpart of the other sign.
    forward: bool,
    /// Whether the first column has a share above zero only.
    positive: bool,
}

static LINES: LazyLock<Vec<Line>> = LazyLock::new(|| {
    // The free form has no cause to be named. Segments of 0.8 s hardly tell a ramp of the rims from a lag or a limit (ADR 0072); wheel speeds over time do (ADR 0073).
    let asked = |e: &&Effect| !matches!(e, Effect::FreeForm(_)) && !OF_RIMS_ALONE.contains(&e.id());
    Effect::examples().iter().filter(asked).flat_map(lines_of).collect()
});

/// Effects of the drive line of a skid-steer base that are asked of wheel speeds over time alone.
const OF_RIMS_ALONE: [&str; 4] = ["acceleration_limit", "turn_acceleration_limit", "wheel_speed_limit", "turn_efficiency"];
/// Effects that wheel speeds of a skid-steer base tell over time beside those, so that nothing else is asked for them where these are measured.
const OF_RIMS: [&str; 11] = [
    "speed_gain",
    "steering_ratio",
    "turn_limit",
    "speed_delay",
    "steering_delay",
    "speed_lag",
    "steering_lag",
    "steering_offset",
    "steering_backlash",
    "skid_steer_track",
    "torque_limit",
];

static RIM_LINES: LazyLock<Vec<Line>> =
    LazyLock::new(|| OF_RIMS.iter().chain(&OF_RIMS_ALONE).filter_map(|id| Effect::example(id)).map(|example| line_of(&example)).collect());

/// Lines of written effects, each once: hypotheses are plain copies, so they stay, as what is written does.
static WRITTEN: Mutex<Vec<&'static Line>> = Mutex::new(Vec::new());

/// The line of a written effect, at the size in which it is written.
fn written_line(written: &Written) -> &'static Line {
    let effect = Effect::Written(written.at(1.0));
    let mut lines = WRITTEN.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(line) = lines.iter().find(|line| line.effect == effect) {
        return line;
    }
    let line: &'static Line = Box::leak(Box::new(line_of(&effect)));
    lines.push(line);
    line
}

/// Hypotheses of one id: each size of an effect is a column of its own; a wheel drag is one hypothesis for each wheel.
fn lines_of(example: &Effect) -> Vec<Line> {
    match example.id() {
        "payload" => vec![payload(*example)],
        "wheel_drag" => {
            let line = |(i, variant)| Line {
                effect: *example,
                variant,
                columns: vec![vec![i as f64, 500.0]],
                free: vec![Free { parameter: 1, mean: 0.0, sd: 2000.0, step: 100.0 }],
                scalings: vec![Scaling::Size],
                forward: true,
                positive: true,
            };
            ["FL", "FR", "RL", "RR"].into_iter().enumerate().map(line).collect()
        }
        _ => vec![line_of(example)],
    }
}

fn line_of(example: &Effect) -> Line {
    let (quantities, values) = (example.quantities(), example.values());
    let sized: Vec<usize> = (0..values.len()).filter(|i| quantities[*i].scaling != Scaling::Held).collect();
    let column = |one: usize| {
        let absent = |i: usize| i != one && quantities[i].scaling == Scaling::Size;
        (0..values.len()).map(|i| if absent(i) { 0.0 } else { values[i] }).collect::<Vec<f64>>()
    };
    let free = sized
        .iter()
        .map(|i| {
            let size = values[*i].abs();
            match quantities[*i].scaling {
                Scaling::Factor => Free { parameter: *i, mean: 1.0, sd: 2.0, step: 0.05 },
                Scaling::Limit => Free { parameter: *i, mean: size, sd: 4.0 * size, step: 0.1 * size },
                _ => Free { parameter: *i, mean: 0.0, sd: SHARE_SD * size, step: 0.2 * size },
            }
        })
        .collect();
    let first = &quantities[sized[0]];
    let size = first.scaling == Scaling::Size;
    Line {
        effect: *example,
        variant: "",
        columns: sized.iter().map(|i| column(*i)).collect(),
        free,
        scalings: sized.iter().map(|i| quantities[*i].scaling).collect(),
        forward: first.scaling == Scaling::Limit || size && first.range[0] > -values[sized[0]].abs(),
        positive: first.scaling == Scaling::Limit || size && first.range[0] >= 0.0,
    }
}

/// A load lies on the floor, the bed or the roof and within the wheelbase or a little behind it (chosen). A payload enters to first order through m, m x,
/// m y and m z.
fn payload(effect: Effect) -> Line {
    let at = |x: f64, y: f64, z: f64| vec![250.0, x, y, z];
    let free = |parameter, mean, sd, step| Free { parameter, mean, sd, step };
    Line {
        effect,
        variant: "",
        columns: vec![at(0.0, 0.0, 0.0), at(1.5, 0.0, 0.0), at(0.0, 0.8, 0.0), at(0.0, 0.0, 1.0)],
        free: vec![free(0, 0.0, 1500.0, 100.0), free(1, 0.0, 1.5, 0.3), free(2, 0.0, 0.5, 0.2), free(3, 0.6, 0.4, 0.3)],
        scalings: vec![Scaling::Size; 4],
        forward: false,
        positive: false,
    }
}

/// Least mass from which the size of a payload is looked for on the car of the catalogue, kg (chosen).
const PAYLOAD_START_KG: f64 = 200.0;

/// One hypothesis: an effect of the catalogue, for a wheel drag at one wheel.
#[derive(Clone, Copy, Debug)]
pub struct Candidate {
    line: &'static Line,
    /// Index of its first column among all.
    first_column: usize,
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.first_column == other.first_column
    }
}

/// All hypotheses, in the order of their columns: the catalogue, then what is written.
pub fn catalogue(written: &[Written]) -> Vec<Candidate> {
    placed(LINES.iter().chain(written.iter().map(written_line)), 0)
}

/// Lines as hypotheses whose columns follow one another from one on.
fn placed(lines: impl Iterator<Item = &'static Line>, mut first_column: usize) -> Vec<Candidate> {
    lines
        .map(|line| {
            let candidate = Candidate { line, first_column };
            first_column += line.columns.len();
            candidate
        })
        .collect()
}

/// The same without what measured wheel speeds of a skid-steer base tell over time, and the hypotheses that are asked of these, in columns behind all others.
pub(crate) fn beside_rims(written: &[Written]) -> (Vec<Candidate>, Vec<Candidate>) {
    let lines = LINES.iter().filter(|line| !OF_RIMS.contains(&line.effect.id())).chain(written.iter().map(written_line));
    let others = placed(lines, 0);
    let of_rims = placed(RIM_LINES.iter(), column_count(&catalogue(written)));
    (others, of_rims)
}

/// Number of columns of the linear form of all hypotheses.
pub fn column_count(catalogue: &[Candidate]) -> usize {
    catalogue.iter().map(|c| c.line.columns.len()).sum()
}

/// Mass from which a vehicle answers to the loads, forces and torques of the catalogue as the car does for which they were chosen, kg (chosen).
const CATALOGUE_MASS_KG: f64 = 2000.0;

/// How far a vehicle is led by an effect in place of what leads the car of the catalogue as far: loads, forces and torques of a robot are smaller, lengths, times and ratios
/// are not.
fn lightness(unit: &str, mass_kg: f64) -> f64 {
    let grows = ["kg", "N", "N m", "N s/m", "N s²/m²"].contains(&unit);
    if grows { (mass_kg / CATALOGUE_MASS_KG).min(1.0) } else { 1.0 }
}

/// Standard deviation of the shares of a linear form.
pub const SHARE_SD: f64 = 3.0;

impl Candidate {
    /// Id of the effect.
    pub fn id(&self) -> &'static str {
        self.line.effect.id()
    }

    /// Id and variant, for tables.
    pub fn label(&self) -> String {
        if self.line.variant.is_empty() { self.id().into() } else { format!("{} {}", self.id(), self.line.variant) }
    }

    /// The wheel of a hypothesis of one wheel, in the order front left, front right, rear left, rear right.
    pub fn wheel(&self) -> Option<usize> {
        let quantities = self.line.effect.quantities();
        let at = quantities.iter().position(|q| q.unit == "index")?;
        Some(self.line.columns[0][at] as usize)
    }

    /// Its columns in the linear form of the catalogue.
    pub fn columns(&self) -> Vec<usize> {
        (self.first_column..self.first_column + self.line.columns.len()).collect()
    }

    /// Effects whose shares span the hypothesis near zero.
    pub fn linear_form(&self) -> Vec<Effect> {
        self.line.columns.iter().map(|values| self.of(values)).collect()
    }

    fn of(&self, values: &[f64]) -> Effect {
        self.line.effect.with_values(values).expect("the catalogue has the parameters of its effects; this is a bug")
    }

    /// Parameters to estimate.
    pub fn free(&self) -> &'static [Free] {
        &self.line.free
    }

    /// Step of the finite differences of a free parameter on a vehicle of this mass (kg).
    pub fn step(&self, i: usize, mass_kg: f64) -> f64 {
        let free = &self.line.free[i];
        free.step * lightness(self.line.effect.quantities()[free.parameter].unit, mass_kg)
    }

    /// Share by which its columns are differentiated on a vehicle of this mass (kg).
    pub fn share_step(&self, mass_kg: f64) -> f64 {
        lightness(self.line.effect.quantities()[self.line.free[0].parameter].unit, mass_kg)
    }

    /// Whether columns are differentiated forward from zero.
    pub fn forward(&self) -> bool {
        self.line.forward
    }

    /// Whether the first column has shares above zero only.
    pub fn positive(&self) -> bool {
        self.line.positive
    }

    /// What somebody wrote down; `None` for one of the catalogue.
    pub fn written(&self) -> Option<Written> {
        self.line.effect.written()
    }

    /// Layer of the effect.
    pub fn layer(&self) -> Layer {
        self.line.effect.layer()
    }

    /// Whether the answer to the effect goes through the contact of the wheels, which is known roughly: forces, soils, maps, and what changes the drive.
    pub fn through_contact(&self) -> bool {
        self.layer().is_force()
            || self.layer() == Layer::Map
            || ["torque_limit", "speed_lag", "speed_delay", "speed_gain", "locked_differential"].contains(&self.id())
    }

    /// The effect with given values of the free parameters.
    pub fn effect(&self, values: &[f64]) -> Effect {
        let mut all = self.line.columns[0].clone();
        for (f, value) in self.line.free.iter().zip(values) {
            all[f.parameter] = *value;
        }
        self.of(&all)
    }

    /// Free parameters per unit share of a hypothesis with one column; `None` for one whose parameters are not proportional to shares.
    pub fn unit(&self) -> Option<f64> {
        match (self.line.columns.as_slice(), self.line.free.as_slice()) {
            ([column], [f]) if self.line.scalings[0] == Scaling::Size => Some(column[f.parameter]),
            _ => None,
        }
    }

    /// Where a refit begins on a vehicle of this mass (kg): the shares of the linear form as physical parameters.
    pub fn start(&self, shares: &[f64], mass_kg: f64) -> Vec<f64> {
        if self.id() == "payload" {
            return payload_start(&self.line.columns, shares, PAYLOAD_START_KG * lightness("kg", mass_kg));
        }
        let of = |(i, f): (usize, &Free)| {
            let [low, high] = self.range(i);
            self.line.scalings[i].apply(self.line.columns[i][f.parameter], shares[i]).clamp(low, high)
        };
        self.line.free.iter().enumerate().map(of).collect()
    }

    /// Share in the first column of a value of the first free parameter; the reverse of [`Candidate::start`].
    pub fn share(&self, value: f64) -> f64 {
        let unit = self.line.columns[0][self.line.free[0].parameter];
        self.line.scalings[0].share(unit, value)
    }

    /// By how much a free parameter changes when the effect grows by its own size, ∂v / ∂ ln share: what its uncertainty is held against. That is |v| for a size or
    /// a limit, and |v ln v| for a factor, which is absent at 1.
    pub fn magnitude(&self, i: usize, value: f64) -> f64 {
        match self.line.scalings[i] {
            Scaling::Factor => (value * value.ln()).abs(),
            _ => value.abs(),
        }
    }

    /// Physical range of a free parameter.
    pub fn range(&self, i: usize) -> [f64; 2] {
        let range = self.of(&self.line.columns[0]).parameters()[self.line.free[i].parameter].range;
        if self.id() == "payload" && i == 0 { [0.0, range[1]] } else { range }
    }

    /// Moves values into the physical range; true where the range holds one of them.
    pub fn clamp(&self, values: &mut [f64]) -> Vec<bool> {
        let quantities = self.of(&self.line.columns[0]).quantities();
        let ends: Vec<([f64; 2], bool)> =
            (0..values.len()).map(|i| (self.range(i), quantities[self.line.free[i].parameter].complete)).collect();
        values
            .iter_mut()
            .zip(ends)
            .map(|(value, ([low, high], complete))| {
                let margin = 0.01 * (high - low);
                let held = *value <= low + if low < 0.0 { margin } else { 0.0 } || !complete && *value >= high - margin;
                *value = value.clamp(low, high);
                held
            })
            .collect()
    }
}

fn payload_start(columns: &[Vec<f64>], shares: &[f64], least_kg: f64) -> Vec<f64> {
    let (mut mass, mut moment) = (0.0f64, [0.0; 3]);
    for (share, column) in shares.iter().zip(columns) {
        mass += share * column[0];
        for axis in 0..3 {
            moment[axis] += share * column[0] * column[1 + axis];
        }
    }
    // A load that was taken away would look the same on the other side; a payload is there.
    let mass_kg = mass.max(least_kg);
    let at = |axis: usize, reach: f64| (moment[axis] / mass_kg).clamp(-reach, reach);
    vec![mass_kg, at(0, 2.0), at(1, 0.8), at(2, 1.2)]
}
