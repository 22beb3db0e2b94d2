//! Servers, plant and models of the laps.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nesam_client::Client;
use nesam_evaluation::Baselines;
use nesam_model::ModelBundle;
use nesam_navigation::{
    BuiltInPlant, Forecaster, KinematicForecaster, LapPlan, PlantLink, ReferencePath, RemotePlant, Run, ServedForecaster, SoilAhead,
    run_lap,
};
use nesam_physics::DT_S;
use nesam_plant::{Ground, HiddenEffects};
use nesam_server::{Config, RunningServer};
use nesam_trajectories::DataRoot;
use serde_json::{Value, json};

use super::{Configuration, NavigateArgs, Task, cost_of, mppi_of, steering_guess};
use crate::commands::serve;
use crate::failure::{Failure, OrFail};
use crate::sources::map_layers;

/// What a buffer would have to add, as share of the prior information, for a filter that is not to learn: no buffer does.
const NEVER_EXCITED: f64 = 1e12;
/// How far stamps may run ahead of the server's clock, s: laps are driven in the plant's time, which passes faster.
const CLOCK_AHEAD_S: f64 = 1e6;

/// Longest wait of a query, s: on a busy machine a lap takes longer and is the same lap.
const DEADLINE_S: f64 = 3600.0;

/// A server on loopback with a client and the maps that it holds.
struct Service {
    server: RunningServer,
    client: Client,
    maps: BTreeSet<String>,
}

/// Everything that laps share.
pub struct Stage<'a> {
    args: &'a NavigateArgs,
    root: DataRoot,
    data: PathBuf,
    bundle: ModelBundle,
    plant: Box<dyn PlantLink>,
    path: ReferencePath,
    learning: Option<Service>,
    fixed: Option<Service>,
    /// What the oracle is told, by world.
    told: Vec<(String, SoilAhead)>,
    driven: usize,
}

impl<'a> Stage<'a> {
    /// Prepares the plant; servers start when they are needed.
    pub fn new(
        args: &'a NavigateArgs,
        root: DataRoot,
        data: PathBuf,
        bundle: ModelBundle,
        effects: HiddenEffects,
    ) -> Result<Self, Failure> {
        let plant: Box<dyn PlantLink> = match &args.plant {
            // The number of the first request differs from process to process, so that a plant never takes it for one that it has answered.
            Some(address) => Box::new(RemotePlant::connect(&address.to_string(), u64::from(std::process::id()) << 20).or_input()?),
            None => Box::new(BuiltInPlant::new(&data, effects).or_input()?),
        };
        let path = ReferencePath::of_ood_soil();
        Ok(Self { args, root, data, bundle, plant, path, learning: None, fixed: None, told: Vec::new(), driven: 0 })
    }

    /// Drives one lap.
    pub async fn drive(&mut self, task: &Task) -> Result<Run, Failure> {
        let mut model = self.model(task).await?;
        let plan = LapPlan {
            world: task.world.clone(),
            start_phi: std::f64::consts::PI * task.start as f64,
            seed: task.seed,
            path: self.path.clone(),
            cost: cost_of(self.args),
            mppi: mppi_of(self.args, &self.bundle.vehicle),
            horizon: self.args.horizon,
            plan_every: self.args.plan_every,
            steering_guess: steering_guess(&self.bundle.vehicle, &self.path),
        };
        let lap = run_lap(&plan, self.plant.as_mut(), &mut model).await.or_failed()?;
        if let Forecaster::Served(served) = model {
            served.close().await.or_failed()?;
        }
        let (configuration, world) = (task.configuration.as_str().to_string(), task.world.clone());
        Ok(Run { configuration, world, soil: task.soil, start: task.start, seed: task.seed, lap })
    }

    /// Stops the servers.
    pub async fn stop(self) {
        for service in [self.learning, self.fixed].into_iter().flatten() {
            service.server.shutdown().await;
        }
    }

    async fn model(&mut self, task: &Task) -> Result<Forecaster, Failure> {
        if task.configuration == Configuration::Kinematic {
            return self.kinematic(&task.world);
        }
        let learning = task.configuration == Configuration::Adapted;
        self.raise(learning, &task.world).await?;
        let told = if task.configuration == Configuration::Oracle { Some(self.told(&task.world).await?) } else { None };
        let service = if learning { &self.learning } else { &self.fixed };
        let client = service.as_ref().map(|s| s.client.clone()).ok_or_else(|| Failure::Failed("the server is gone".into()))?;
        self.driven += 1;
        let served = ServedForecaster::open(client, &format!("lap-{}", self.driven), &task.world, told).await.or_failed()?;
        Ok(Forecaster::Served(Box::new(served)))
    }

    fn kinematic(&self, world: &str) -> Result<Forecaster, Failure> {
        let json = self.bundle.baselines_json.as_deref();
        let json = json.ok_or_else(|| Failure::input(format!("bundle {} carries no fitted kinematic model", self.bundle.name)))?;
        let model = Baselines::from_json(json).or_input()?.kinematic;
        let map = self.root.world(world).or_input()?;
        Ok(Forecaster::Kinematic(KinematicForecaster { model, vehicle: Arc::new(self.bundle.vehicle.clone()), map }))
    }

    /// Starts the server that learns, or the one that does not, unless it runs, and gives it the map of a world.
    async fn raise(&mut self, learning: bool, world: &str) -> Result<(), Failure> {
        let slot = if learning { &mut self.learning } else { &mut self.fixed };
        let service = match slot {
            Some(service) => service,
            None => {
                let bundle = if learning { self.bundle.clone() } else { without_learning(&self.bundle)? };
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
            service.client.upload_map(&map_layers(&map)).await.or_failed()?;
        }
        Ok(())
    }

    /// What the oracle is told of a world: reads its true soil.
    async fn told(&mut self, world: &str) -> Result<SoilAhead, Failure> {
        if let Some((_, told)) = self.told.iter().find(|(known, _)| known == world) {
            return Ok(told.clone());
        }
        let ground = Ground::read(&world_dir(&self.data, world)).or_input()?;
        let service = self.fixed.as_mut().ok_or_else(|| Failure::Failed("the server is gone".into()))?;
        let stretch_m = self.args.speed * DT_S * self.args.horizon as f64;
        let told = SoilAhead::along(&mut service.client, world, &ground, &self.path, stretch_m).await.or_failed()?;
        self.told.push((world.into(), told.clone()));
        Ok(told)
    }
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
