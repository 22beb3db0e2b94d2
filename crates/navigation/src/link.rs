//! The way to a plant, whichever it is.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use nesam_physics::Control;
use nesam_plant::{Command, Ground, HiddenEffects, Measured, Plant, PlantVehicle, Sensors};

use crate::error::NavigationError;

/// How a plant is set down: at rest, on fresh soil.
#[derive(Clone, Debug, PartialEq)]
pub struct Start {
    /// World.
    pub world: String,
    /// Seed of the sensors.
    pub seed: u64,
    /// x, y in World, m.
    pub position_m: [f64; 2],
    /// Heading, rad.
    pub yaw_rad: f64,
}

/// What a plant tells at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// Measured x y z roll pitch yaw vx vy vz wx wy wz.
    pub measured: [f64; 12],
    /// The same without sensor errors, for the score only; `None` where the plant does not tell.
    pub truth: Option<[f64; 12]>,
}

impl Reading {
    /// What laps are scored by: the truth where the plant tells it.
    pub fn scored(&self) -> &[f64; 12] {
        self.truth.as_ref().unwrap_or(&self.measured)
    }
}

/// What a plant answers.
#[derive(Clone, Debug, PartialEq)]
pub enum Answer {
    /// What is the case now.
    Reading(Reading),
    /// The lap is over for this plant, and why.
    Ended(String),
}

impl Answer {
    /// The reading, where it is one.
    pub fn reading(&self) -> Option<Reading> {
        match self {
            Self::Reading(reading) => Some(*reading),
            Self::Ended(_) => None,
        }
    }
}

/// A plant in lock-step: it moves only when it is told to, 0.1 s at a time.
pub trait PlantLink {
    /// Sets the vehicle down.
    ///
    /// # Errors
    /// `NavigationError` when there is no such plant or world.
    fn reset(&mut self, start: &Start) -> Result<Answer, NavigationError>;

    /// Holds a command for 0.1 s.
    ///
    /// # Errors
    /// `NavigationError` when the plant does not answer; `NavigationError::Lost` when the lap can be driven again from `reset`.
    fn step(&mut self, command: Control<f64>) -> Result<Answer, NavigationError>;

    /// What the plant calls itself; `None` where it does not tell. A plant that has to be asked is set down at `start`.
    ///
    /// # Errors
    /// As [`PlantLink::reset`].
    fn name(&mut self, _start: &Start) -> Result<Option<String>, NavigationError> {
        Ok(None)
    }
}

/// The plant of `tests/plant` in this process.
pub struct BuiltInPlant {
    worlds: PathBuf,
    vehicle: Arc<PlantVehicle>,
    grounds: HashMap<String, Arc<Ground>>,
    effects: HiddenEffects,
    running: Option<(Plant, Sensors)>,
}

impl BuiltInPlant {
    /// A plant of the vehicle and the worlds of a data root.
    ///
    /// # Errors
    /// `NavigationError::BuiltIn` when the root has no data sheet.
    pub fn new(root: &std::path::Path, effects: HiddenEffects) -> Result<Self, NavigationError> {
        let vehicle = Arc::new(PlantVehicle::of_root(root)?);
        Ok(Self { worlds: root.join("worlds"), vehicle, grounds: HashMap::new(), effects, running: None })
    }

    /// The ground of a world, read once.
    ///
    /// # Errors
    /// `NavigationError::BuiltIn` when the world is missing, damaged or without true soil.
    pub fn ground(&mut self, world: &str) -> Result<Arc<Ground>, NavigationError> {
        if let Some(ground) = self.grounds.get(world) {
            return Ok(Arc::clone(ground));
        }
        let ground = Arc::new(Ground::read(&self.worlds.join(world))?);
        self.grounds.insert(world.into(), Arc::clone(&ground));
        Ok(ground)
    }
}

impl PlantLink for BuiltInPlant {
    fn reset(&mut self, start: &Start) -> Result<Answer, NavigationError> {
        let ground = self.ground(&start.world)?;
        let [x, y] = start.position_m;
        let plant = Plant::at_rest(Arc::clone(&self.vehicle), ground, self.effects, x, y, start.yaw_rad);
        let mut sensors = Sensors::new(start.seed, &self.effects);
        let answer = read(&plant, &mut sensors);
        self.running = Some((plant, sensors));
        Ok(answer)
    }

    fn step(&mut self, command: Control<f64>) -> Result<Answer, NavigationError> {
        let (plant, sensors) = self.running.as_mut().ok_or_else(|| NavigationError::Plant {
            address: "in this process".into(),
            reason: "reset comes before the first step".into(),
        })?;
        plant.advance(Command { speed_m_s: command.speed_m_s, steering: command.second });
        Ok(read(plant, sensors))
    }
}

fn read(plant: &Plant, sensors: &mut Sensors) -> Answer {
    let truth = plant.truth();
    let Measured { state, .. } = sensors.read(&truth);
    Answer::Reading(Reading { measured: state, truth: Some(truth.state) })
}
