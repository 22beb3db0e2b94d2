//! Sets the stage: server, map, session, vehicle, planner and live table, and takes it down again.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use nesam_client::zenoh_vehicle::ZenohVehicle;
use nesam_client::{Candidates, Client, Prediction, v1};
use nesam_model::ModelBundle;
use nesam_physics::Control;
use nesam_server::{Config, RunningServer, termination};
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::ledger::Ledger;
use super::planner::{CANDIDATES, HORIZON, Planner};
use super::summary::Summary;
use super::vehicle::{FAST_STRIDE, Player};
use crate::commands::serve;
use crate::failure::{Failure, OrFail};
use crate::output::say;

/// Name of the vehicle, its session and its fleet.
const NAME: &str = "demo";
/// Time between rows of the live table.
const ROW_EVERY: Duration = Duration::from_millis(500);
/// Samples for which a plan is shown.
const PLAN_SHOWN: usize = 10;
/// Cycles between two questions for the covariance of a prediction.
const REGION_EVERY: usize = 5;
/// Seed of the planner's noise.
const SEED: u64 = 1;

/// What is played, and how.
pub struct Stage {
    /// Recorded drive.
    pub drive: Arc<Trajectory>,
    /// Its map, if there is one.
    pub map: Option<Arc<WorldMap>>,
    /// Samples to play.
    pub samples: usize,
    /// Playback speed.
    pub rate: f64,
    /// Without pauses.
    pub fast: bool,
    /// Address of the live page; `None` = a free port of loopback.
    pub http: Option<SocketAddr>,
}

/// A drive that was played.
pub struct Played {
    /// What came of it.
    pub summary: Summary,
    /// The server, which goes on serving.
    pub server: RunningServer,
    /// Ends with ctrl-c or SIGTERM, also where that came during the drive.
    pub interrupted: JoinHandle<()>,
}

/// What the live table shows.
struct Shared {
    ledger: Ledger,
    newest: Option<Prediction>,
    /// Sample of the newest plan, and its first command.
    plan: Option<(usize, Control<f64>)>,
    cost_sum: f64,
}

impl Stage {
    /// Plays the drive through a real server, which goes on serving.
    pub async fn play(self, bundle: ModelBundle) -> Result<Played, Failure> {
        let mut interrupted = tokio::spawn(termination());
        let endpoint = format!("tcp/127.0.0.1:{}", free_port()?);
        let vehicle_card = bundle.vehicle.clone();
        let server = raise(bundle, &endpoint, self.http).await?;
        let mut client = Client::connect(&format!("http://{}", server.grpc_addr)).await.or_failed()?;
        self.prepare(&mut client).await?;
        let vehicle = ZenohVehicle::connect(&endpoint, NAME, NAME).await.or_failed()?;
        vehicle.wait_for_service(Duration::from_secs(10)).await.or_failed()?;
        say!("vehicle   plays {} over zenoh, {:.1} s{}", self.drive.id, self.samples as f64 * self.drive.dt_s, self.pace());
        say!("planner   asks over grpc for {CANDIDATES} candidates of {HORIZON} steps per cycle\n");

        let shared = Arc::new(Mutex::new(Shared { ledger: Ledger::new(Arc::clone(&self.drive)), newest: None, plan: None, cost_sum: 0.0 }));
        let (applied, applied_seen) = watch::channel(None);
        let (planned, planned_seen) = watch::channel(None);
        let player = Player {
            drive: Arc::clone(&self.drive),
            samples: self.samples,
            plan_until: self.plan_until(),
            rate: self.rate,
            fast: self.fast,
            applied,
            planned: planned_seen,
        };
        let planner = Planner::new(&vehicle_card, SEED);
        let planning = tokio::spawn(self.cycle(client, planner, applied_seen.clone(), planned, Arc::clone(&shared)));
        let begin = Instant::now();
        let table = tokio::spawn(live_table(Arc::clone(&self.drive), applied_seen.clone(), Arc::clone(&shared)));
        let played = tokio::select! {
            outcomes = player.play(&vehicle) => outcomes?,
            _ = &mut interrupted => {
                say!("interrupted; this is what there is so far");
                Default::default()
            }
        };
        planning.abort();
        table.abort();
        // An aborted task has ended when it is joined; only then is what it shared final. A failure of the planner is the demo's failure.
        if let Ok(Err(failure)) = planning.await {
            return Err(failure);
        }
        let now = applied_seen.borrow().unwrap_or(0);
        let _ = vehicle.close().await;
        let shared = shared.lock().map_err(|_| Failure::Failed("the planner ended early".into()))?;
        Ok(Played { summary: self.summary(&shared, now, begin.elapsed().as_secs_f64(), played), server, interrupted })
    }

    fn summary(&self, shared: &Shared, now: usize, wall_s: f64, outcomes: BTreeMap<&'static str, usize>) -> Summary {
        let queries = shared.ledger.queries();
        Summary {
            drive: self.drive.id.clone(),
            played_s: now as f64 * self.drive.dt_s,
            wall_s,
            scores: shared.ledger.scores(now),
            latency_s: shared.ledger.latency_quantiles_s(&[0.5, 0.9, 0.99]),
            queries,
            candidates: queries * CANDIDATES,
            plan_cost: shared.cost_sum / queries.max(1) as f64,
            outcomes,
        }
    }

    fn pace(&self) -> String {
        if self.fast { ", without pauses".into() } else { format!(" at {} times the recorded speed", self.rate) }
    }

    /// The planner plans at samples below this one: there the recorded driver has a whole horizon of commands.
    fn plan_until(&self) -> usize {
        self.samples.min(self.drive.states.len() - HORIZON)
    }

    /// Uploads the map and opens the session.
    async fn prepare(&self, client: &mut Client) -> Result<(), Failure> {
        let mut map_id = String::new();
        if let Some(map) = &self.map {
            let uploaded = client.upload_map(&nesam_navigation::map_layers(map)).await.or_failed()?;
            say!("map       {} uploaded, {} x {} cells of {} m", uploaded.map_id, uploaded.width, uploaded.height, uploaded.resolution_m);
            map_id = uploaded.map_id;
        }
        let request = v1::OpenSessionRequest { vehicle_id: NAME.into(), map_id, ..Default::default() };
        client.open_session(request).await.or_failed()?;
        Ok(())
    }

    /// The planner's loop: whenever a new measurement is in the history, asks for predictions and moves the plan.
    fn cycle(
        &self,
        mut client: Client,
        mut planner: Planner,
        mut applied: watch::Receiver<Option<usize>>,
        planned: watch::Sender<Option<usize>>,
        shared: Arc<Mutex<Shared>>,
    ) -> impl Future<Output = Result<(), Failure>> + use<> {
        let (drive, until, fast) = (Arc::clone(&self.drive), self.plan_until(), self.fast);
        // The page draws where the driver's own commands lead and how sure that is; without pauses nobody looks.
        let mut regions = !fast;
        let mut cycles = 0_usize;
        async move {
            while applied.changed().await.is_ok() {
                let Some(at) = *applied.borrow_and_update() else { continue };
                if at >= until || (fast && at % FAST_STRIDE != 0) {
                    continue;
                }
                let candidates = planner.candidates(&drive.controls[at..at + HORIZON]);
                let driver = candidates[..2 * HORIZON].to_vec();
                let asked = Instant::now();
                let prediction = client.predict(Candidates::new(NAME, CANDIDATES, HORIZON, candidates)).await.or_failed()?;
                let latency_s = asked.elapsed().as_secs_f64();
                let column = |p: &Prediction, n: usize, k: usize, c: usize| f64::from(p.state(n, k)[c]);
                let poses: Vec<[f64; 4]> = (0..CANDIDATES * HORIZON)
                    .map(|row| [0, 1, 3, 4].map(|c| column(&prediction, row / HORIZON, row % HORIZON, c)))
                    .collect();
                let path: Vec<[f64; 2]> = drive.states[at + 1..=at + HORIZON].iter().map(|s| [s.position_m[0], s.position_m[1]]).collect();
                let Some(decision) = planner.decide(&poses, &prediction.validity, &path) else { continue };
                // A measurement that arrived while the request travelled moves the start; then the driver's commands are of another instant.
                let same_start = prediction.start[..2] == drive.states[at].position_m[..2];
                {
                    let Ok(mut state) = shared.lock() else { break };
                    if same_start {
                        let driver: Vec<[f64; 2]> = poses[..HORIZON].iter().map(|p| [p[0], p[1]]).collect();
                        state.ledger.enter(at, &driver, latency_s);
                        state.cost_sum += decision.best_cost;
                    }
                    state.plan = Some((at, decision.command));
                    state.newest = Some(prediction);
                }
                planned.send_replace(Some(at));
                if regions && cycles.is_multiple_of(REGION_EVERY) {
                    let extras = Some(v1::PredictExtras { covariance: true, ..Default::default() });
                    // A bundle that does not know its errors refuses; it need not be asked again.
                    regions = client.predict(Candidates { extras, ..Candidates::new(NAME, 1, HORIZON, driver) }).await.is_ok();
                }
                cycles += 1;
            }
            Ok(())
        }
    }
}

/// Starts the server on loopback, with Zenoh at `endpoint`, and says where it is.
async fn raise(bundle: ModelBundle, endpoint: &str, http: Option<SocketAddr>) -> Result<RunningServer, Failure> {
    let mut config = Config::ephemeral();
    config.http.listen = http.unwrap_or(config.http.listen);
    config.zenoh.enabled = true;
    config.zenoh.listen = vec![endpoint.into()];
    config.zenoh.fleet = NAME.into();
    let (server, bundle) = serve::start(config, bundle).await?;
    say!("server    grpc {}, zenoh {endpoint}, bundle {} {}", server.grpc_addr, bundle.name, &bundle.hash[..12]);
    if let Some(http) = server.http_addr {
        say!("          watch http://{http}/, metrics http://{http}/metrics");
    }
    Ok(server)
}

async fn live_table(drive: Arc<Trajectory>, applied: watch::Receiver<Option<usize>>, shared: Arc<Mutex<Shared>>) {
    say!("                                       error of the         soil under the vehicle     planner wants      round trip");
    say!("    t s      x m      y m    yaw °   3.2 s forecast m     φ °   c kPa      n -       m/s    second      p50 ms");
    let mut tick = tokio::time::interval(ROW_EVERY);
    let mut shown = None;
    loop {
        tick.tick().await;
        let now = *applied.borrow();
        let (Some(i), Ok(state)) = (now, shared.lock()) else { continue };
        if now == shown {
            continue;
        }
        shown = now;
        let measured = &drive.states[i];
        let number =
            |v: Option<f64>, width: usize, digits: usize| v.map_or(format!("{:>width$}", "–"), |v| format!("{v:width$.digits$}"));
        let plan = state.plan.filter(|(at, _)| at + PLAN_SHOWN >= i).map(|(_, command)| command);
        let soil = state.newest.as_ref().map(|p| p.soil);
        let latency = Some(1e3 * state.ledger.latency_median_s()).filter(|v| v.is_finite());
        say!(
            "{:7.1}{:9.2}{:9.2}{:9.1}{}{}{}{}{}{}{}",
            drive.time_s[i],
            measured.position_m[0],
            measured.position_m[1],
            measured.attitude_rad[2].to_degrees(),
            number(state.ledger.error_now_m(i), 19, 2),
            number(soil.map(|s| s[4].to_degrees()), 8, 1),
            number(soil.map(|s| s[3] / 1e3), 8, 1),
            number(soil.map(|s| s[2]), 9, 2),
            number(plan.map(|c| c.speed_m_s), 10, 2),
            number(plan.map(|c| c.second), 10, 2),
            number(latency, 12, 1),
        );
    }
}

/// A port of loopback that is free now.
fn free_port() -> Result<u16, Failure> {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").or_failed()?;
    Ok(listener.local_addr().or_failed()?.port())
}
