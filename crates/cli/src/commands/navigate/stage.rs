//! Servers, plant and models of the laps.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use nesam_client::Client;
use nesam_evaluation::{Baselines, Kinematic};
use nesam_model::ModelBundle;
use nesam_navigation::{
    Answer, BuiltInPlant, Forecaster, KinematicForecaster, Lap, LapPlan, NavigationError, PlantLink, ReferencePath, RemotePlant, Run,
    ServedForecaster, SoilAhead, Start, Surroundings, run_lap,
};
use nesam_physics::{Control, DT_S};
use nesam_plant::{Ground, HiddenEffects};
use nesam_server::{Config, RunningServer};
use nesam_trajectories::DataRoot;
use serde_json::{Value, json};

use super::laps::Identity;
use super::{Configuration, NavigateArgs, Task, caution_of, cost_of, mppi_of, steering_guess};
use crate::commands::serve;
use crate::failure::{Failure, OrFail};
use crate::interrupt;

/// What a buffer would have to add, as share of the prior information, for a filter that is not to learn: no buffer does.
const NEVER_EXCITED: f64 = 1e12;
/// How far stamps may run ahead of the server's clock, s: laps are driven in the plant's time, which passes faster.
const CLOCK_AHEAD_S: f64 = 1e6;

/// Longest wait of a query, s: on a busy machine a lap takes longer and is the same lap.
const DEADLINE_S: f64 = 3600.0;

/// Time after which a plant that is silent counts as gone, s: the slowest simulators take minutes to set a vehicle down.
const PLANT_TIMEOUT_S: u64 = 1800;

/// A server on loopback with a client and the maps that it holds.
struct Service {
    server: RunningServer,
    client: Client,
    maps: BTreeSet<String>,
}

/// The models of the laps.
pub struct Bundles {
    /// Of all configurations but one.
    pub shipped: ModelBundle,
    /// With the effects that a diagnosis found.
    pub diagnosed: Option<ModelBundle>,
}

/// A plant that is driven no further after Ctrl-C.
struct Interruptible(Box<dyn PlantLink>);

impl PlantLink for Interruptible {
    fn reset(&mut self, start: &Start) -> Result<Answer, NavigationError> {
        self.0.reset(start)
    }

    fn step(&mut self, command: Control<f64>) -> Result<Answer, NavigationError> {
        if interrupt::is_noted() { Err(NavigationError::Interrupted) } else { self.0.step(command) }
    }

    fn name(&mut self, start: &Start) -> Result<Option<String>, NavigationError> {
        self.0.name(start)
    }
}

/// Which server a lap is predicted by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    /// Its soil stays the prior.
    Fixed,
    /// It learns the soil.
    Learning,
    /// So does this one, with the effects of the diagnosis.
    Diagnosed,
}

/// Everything that laps share.
pub struct Stage<'a> {
    args: &'a NavigateArgs,
    root: DataRoot,
    data: PathBuf,
    bundles: Bundles,
    plant: Interruptible,
    path: ReferencePath,
    services: BTreeMap<Kind, Service>,
    /// What the oracle is told, by world.
    told: Vec<(String, SoilAhead)>,
    driven: usize,
}

impl<'a> Stage<'a> {
    /// Prepares the plant; servers start when they are needed.
    pub fn new(args: &'a NavigateArgs, root: DataRoot, data: PathBuf, bundles: Bundles, effects: HiddenEffects) -> Result<Self, Failure> {
        let plant: Box<dyn PlantLink> = match &args.plant {
            Some(address) => {
                let timeout = Duration::from_secs(args.plant_timeout.unwrap_or(PLANT_TIMEOUT_S));
                let plant = RemotePlant::connect(address, first_number(), timeout).or_input()?;
                Box::new(plant.telling(|text| crate::output::note!("note: {text}")).until(interrupt::is_noted))
            }
            None => Box::new(BuiltInPlant::new(&data, effects).or_input()?),
        };
        let path = ReferencePath::of_ood_soil();
        let plant = Interruptible(plant);
        Ok(Self { args, root, data, bundles, plant, path, services: BTreeMap::new(), told: Vec::new(), driven: 0 })
    }

    /// Which plant it is: another simulator is asked for the start of the first lap.
    pub fn identity(&mut self, first: &Task) -> Result<Identity, Failure> {
        let Some(address) = &self.args.plant else { return Ok(Identity::BuiltIn) };
        crate::output::note!("plant {address}: asking for the start of the first lap");
        let start = self.plan_of(first).start();
        let name = self.plant.name(&start).or_failed()?;
        if name.is_none() && !self.args.resume {
            crate::output::note!(
                "note: the answer to the first `reset` did not say which plant it is (`plant`): earlier laps are driven again; --resume takes them"
            );
        }
        Ok(name.map_or(Identity::Unnamed, Identity::Named))
    }

    fn plan_of(&self, task: &Task) -> LapPlan {
        LapPlan {
            world: task.world.clone(),
            start_phi: std::f64::consts::PI * task.start as f64,
            seed: task.seed,
            path: self.path.clone(),
            cost: cost_of(self.args),
            mppi: mppi_of(self.args, &self.bundles.shipped.vehicle),
            horizon: self.args.horizon,
            plan_every: self.args.plan_every,
            steering_guess: steering_guess(&self.bundles.shipped.vehicle, &self.path, self.args.speed),
            caution: caution_of(self.args),
        }
    }

    /// Drives one lap; once again where the plant lost it on the way.
    pub async fn drive(&mut self, task: &Task) -> Result<Run, Failure> {
        let lap = match self.lap(task).await? {
            Err(lost @ NavigationError::Lost { .. }) if !interrupt::is_noted() => {
                crate::output::note!("note: {}: {lost}; it is driven once again", task.file_name());
                self.lap(task).await?
            }
            other => other,
        };
        let (configuration, world) = (task.configuration.as_str().to_string(), task.world.clone());
        Ok(Run { configuration, world, soil: task.soil, start: task.start, seed: task.seed, lap: lap.or_failed()? })
    }

    /// One try of a lap, with a session of its own; what failed on the way is told apart from what failed before.
    async fn lap(&mut self, task: &Task) -> Result<Result<Lap, NavigationError>, Failure> {
        let mut model = self.model(task).await?;
        let lap = run_lap(&self.plan_of(task), &mut self.plant, &mut model).await;
        if let Forecaster::Served(served) = model {
            let closed = served.close().await;
            // A lap that failed says more than the session that it leaves.
            if lap.is_ok() {
                closed.or_failed()?;
            }
        }
        Ok(lap)
    }

    /// Stops the servers.
    pub async fn stop(self) {
        for service in self.services.into_values() {
            service.server.shutdown().await;
        }
    }

    async fn model(&mut self, task: &Task) -> Result<Forecaster, Failure> {
        let kind = match task.configuration {
            Configuration::Kinematic => return self.kinematic(&task.world),
            Configuration::Fixed | Configuration::Oracle => Kind::Fixed,
            Configuration::Adapted => Kind::Learning,
            Configuration::Diagnosed => Kind::Diagnosed,
        };
        let client = self.raise(kind, &task.world).await?.client.clone();
        let told = if task.configuration == Configuration::Oracle { Some(self.told(client.clone(), &task.world).await?) } else { None };
        self.driven += 1;
        let map = self.root.world(&task.world).or_input()?;
        let surroundings = Surroundings { map, vehicle: Arc::new(self.bundles.shipped.vehicle.clone()) };
        let served = ServedForecaster::open(client, &format!("lap-{}", self.driven), surroundings, told).await.or_failed()?;
        Ok(Forecaster::Served(Box::new(served)))
    }

    fn kinematic(&self, world: &str) -> Result<Forecaster, Failure> {
        let bundle = &self.bundles.shipped;
        let model = kinematic_of(bundle)?;
        let map = self.root.world(world).or_input()?;
        Ok(Forecaster::Kinematic(KinematicForecaster { model, vehicle: Arc::new(bundle.vehicle.clone()), map }))
    }

    /// The server of a kind, which is started unless it runs and given the map of a world.
    async fn raise(&mut self, kind: Kind, world: &str) -> Result<&Service, Failure> {
        let service = match self.services.entry(kind) {
            Entry::Occupied(running) => running.into_mut(),
            Entry::Vacant(slot) => {
                let bundle = match kind {
                    Kind::Fixed => without_learning(&self.bundles.shipped)?,
                    Kind::Learning => self.bundles.shipped.clone(),
                    Kind::Diagnosed => self.bundles.diagnosed.clone().expect("options without --diagnosed are refused; this is a bug"),
                };
                let mut config = Config::ephemeral();
                config.http.enabled = false;
                config.limits.clock_ahead_max_s = CLOCK_AHEAD_S;
                config.grpc.deadline_s = DEADLINE_S;
                let (server, _) = serve::start(config, bundle).await?;
                let client = Client::connect(&format!("http://{}", server.grpc_addr)).await.or_failed()?;
                slot.insert(Service { server, client, maps: BTreeSet::new() })
            }
        };
        if service.maps.insert(world.into()) {
            let map = self.root.world(world).or_input()?;
            service.client.upload_map(&nesam_navigation::map_layers(&map)).await.or_failed()?;
        }
        Ok(service)
    }

    /// What the oracle is told of a world: reads its true soil.
    async fn told(&mut self, mut client: Client, world: &str) -> Result<SoilAhead, Failure> {
        if let Some((_, told)) = self.told.iter().find(|(known, _)| known == world) {
            return Ok(told.clone());
        }
        let ground = Ground::read(&world_dir(&self.data, world)).or_input()?;
        let stretch_m = self.args.speed * DT_S * self.args.horizon as f64;
        let told = SoilAhead::along(&mut client, world, &ground, &self.path, stretch_m).await.or_failed()?;
        self.told.push((world.into(), told.clone()));
        Ok(told)
    }
}

/// The kinematic model that was fitted for the vehicle of a bundle.
pub fn kinematic_of(bundle: &ModelBundle) -> Result<Kinematic, Failure> {
    let fitted = bundle.baselines_json.as_deref().map(Baselines::from_json).transpose().or_input()?;
    match fitted {
        Some(baselines) if baselines.vehicle == bundle.vehicle.name => Ok(baselines.kinematic),
        _ => Err(Failure::input(format!("bundle {} carries no kinematic model fitted for `{}`", bundle.name, bundle.vehicle.name))),
    }
}

/// Microseconds since 1970, which later commands have more of, so that a plant never takes a request for one that it has answered; below 2^53, which every
/// language counts to exactly, until 2255.
fn first_number() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_micros() as u64)
}

fn world_dir(data: &Path, world: &str) -> PathBuf {
    data.join("worlds").join(world)
}

/// The same bundle with a soil filter that never learns: the soil stays the prior.
fn without_learning(bundle: &ModelBundle) -> Result<ModelBundle, Failure> {
    let mut filter: Value = match &bundle.soil_filter_json {
        Some(text) => serde_json::from_str(text).or_input()?,
        None => json!({ "schema": "nesam.soil_filter/1", "settings": {}, "drives": 0, "buffers": 0, "data_hash": "" }),
    };
    filter["settings"]["excitation_min"] = json!(NEVER_EXCITED);
    Ok(ModelBundle { soil_filter_json: Some(filter.to_string()), ..bundle.clone() })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: ids of a later command are above those of an earlier one, wherever either runs. Method: the clock against 2024 and 2^53; a campaign asks less than once
    /// in a microsecond.
    #[test]
    fn property_ids_grow_from_command_to_command() {
        let number = first_number();
        assert!((1_704_067_200_000_000..1 << 53).contains(&number), "{number}");
        std::thread::sleep(Duration::from_millis(1));
        assert!(first_number() > number);
    }
}
