//! Goal: a second vehicle begins from what the first has learned of the ground, nothing is counted twice, and nobody shares who was not asked to.

use std::time::Duration;

use nesam_adaptation::FilterConfig;
use nesam_client::v1;
use nesam_engine::{Command, Engine, FleetSoilSettings, Limits, OpenSession, Reply, SOIL_NOT_LEARNED, SessionImage, SessionView};
use nesam_server::convert::{image_bytes, session_image};
use prost::Message as _;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Code, Request, Response, Status};

use crate::stage::*;
use crate::zenoh_network::{PATIENCE, behind, router};

#[tokio::test(flavor = "multi_thread")]
async fn service_a_second_vehicle_begins_from_what_the_first_has_learned() {
    let recorded = recorded();
    let (router, endpoint) = router().await;
    let (server, mut client) = start_with(|config| {
        config.fleet_soil.enabled = true;
        behind(config, &endpoint);
    })
    .await;
    let published = router.declare_subscriber("nesam/v1/test/soil_map").await.unwrap();
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "first", recorded.world.id()).await;
    assert!(client.fleet_soil("").await.unwrap().cells.is_empty());
    client.feed(samples("first", &recorded.drive, 70)).await.unwrap();
    let first = client.session("first").await.unwrap();
    let updates = first.provenance.unwrap().soil_epoch;
    let map = client.fleet_soil(recorded.world.id()).await.unwrap();
    let buffers: f64 = map.cells.iter().map(|cell| cell.buffers).sum();
    assert!(updates >= 4 && (buffers - updates as f64).abs() < 0.01, "{buffers} buffers of {updates} updates");
    assert!(map.cells.iter().all(|c| c.map_id == recorded.world.id() && c.information.len() == 36 && c.age_s < 60.0));
    assert!(client.fleet_soil("nowhere").await.unwrap().cells.is_empty());
    for _ in 0..updates {
        let sample = tokio::time::timeout(PATIENCE, published.recv_async()).await.expect("in time").unwrap();
        let changed = v1::FleetSoilMap::decode(sample.payload().to_bytes().as_ref()).unwrap();
        assert_eq!((changed.cells.len(), changed.cell_m), (1, map.cell_m));
    }

    // A copy that drives on brings nothing: its evidence would be that of the original.
    client.fork_session("first", "copy").await.unwrap();
    client.feed((71..=100).map(|i| sample("copy", &recorded.drive, i)).collect()).await.unwrap();
    assert_eq!(client.fleet_soil("").await.unwrap().cells.len(), map.cells.len());

    let opened = open(&mut client, "second", recorded.world.id()).await;
    let prior = opened.soil_correction.unwrap();
    let answer = client.feed(samples("second", &recorded.drive, 0)).await.unwrap().remove(0);
    let begun = answer.soil_correction.unwrap();
    assert_eq!(answer.soil_epoch, 1);
    assert_ne!(begun.delta, prior.delta);
    assert!((0..6).all(|i| begun.covariance[7 * i].is_finite() && begun.covariance[7 * i] > 0.0));
    // It is a second session of the same vehicle here, so it brings nothing either.
    client.feed((1..=30).map(|i| sample("second", &recorded.drive, i)).collect()).await.unwrap();
    let after: f64 = client.fleet_soil("").await.unwrap().cells.iter().map(|cell| cell.buffers).sum();
    assert!(after <= buffers, "{after} buffers");
    let prediction = client.predict(candidates("second", &recorded.drive, 30, 1, 4)).await.unwrap();
    assert_eq!(prediction.validity[0] & v1::Validity::SoilNotLearned as u32, 0);
    server.shutdown().await;
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn service_without_the_map_every_session_begins_alone() {
    let (server, mut client, recorded) = start_on_map().await;
    for session in ["first", "second"] {
        open(&mut client, session, recorded.world.id()).await;
    }
    client.feed(samples("first", &recorded.drive, 40)).await.unwrap();
    let answer = client.feed(samples("second", &recorded.drive, 0)).await.unwrap().remove(0);
    assert_eq!(answer.soil_epoch, 0);
    assert_refused("no map", client.fleet_soil("").await, Code::FailedPrecondition, "map_id");
    tokio::time::timeout(Duration::from_secs(20), server.shutdown()).await.unwrap();
}

#[test]
fn property_a_buffer_that_tells_nothing_brings_nothing() {
    let recorded = recorded();
    let cells_and_flags = |excitation_min: f64| {
        let filter = FilterConfig { excitation_min, ..filter_config() };
        let engine = Engine::new(predictor(), Limits::default()).unwrap().with_filter(filter).unwrap();
        let mut engine = engine.with_fleet_soil(FleetSoilSettings::default()).unwrap();
        let mut call = |command: Command| engine.execute(0, &command).unwrap();
        call(Command::PutMap { map: recorded.world.clone(), base: None });
        call(Command::Open(OpenSession { vehicle: "truck".into(), map: recorded.world.id().into(), ..Default::default() }));
        for i in 0..=60 {
            call(Command::Measure { session: "truck".into(), vehicle: None, measurement: engine_sample(&recorded.drive, i) });
        }
        let Reply::FleetShares(_, shares) = call(Command::TellFleetSoil) else { panic!("another reply") };
        let query = engine_query("truck", &recorded.drive, 60, 1, 1);
        let Reply::Predicted(prediction) = call(Command::Predict(query)) else { panic!("another reply") };
        (shares.iter().map(|share| share.cells.len()).sum::<usize>(), prediction.rollout.flags[0] & SOIL_NOT_LEARNED)
    };
    let (cells, not_learned) = cells_and_flags(filter_config().excitation_min);
    assert!(cells > 0 && not_learned == 0);
    // The estimate stayed as it was while P was expected to widen: no difference of the two is evidence.
    assert_eq!(cells_and_flags(1e12), (0, SOIL_NOT_LEARNED));
}

/// An engine that keeps a soil map of the fleet, with the recorded world.
struct Sharing {
    engine: Engine,
    recorded: Recorded,
}

impl Sharing {
    fn new() -> Self {
        let engine = Engine::new(predictor(), Limits::default()).unwrap();
        let mut sharing = Self { engine: engine.with_fleet_soil(FleetSoilSettings::default()).unwrap(), recorded: recorded() };
        sharing.ask(Command::PutMap { map: sharing.recorded.world.clone(), base: None });
        sharing
    }

    fn ask(&mut self, command: Command) -> Reply {
        self.engine.execute(0, &command).unwrap()
    }

    fn open(&mut self, vehicle: &str, initial: Option<nesam_engine::Measurement>) -> SessionView {
        let map = self.recorded.world.id().into();
        let open = OpenSession { vehicle: vehicle.into(), map, initial, ..Default::default() };
        let Reply::Session(view) = self.ask(Command::Open(open)) else { panic!("another reply") };
        *view
    }

    fn measure(&mut self, session: &str, measurement: nesam_engine::Measurement) -> nesam_engine::MeasureAnswer {
        let Reply::Measured(answer) = self.ask(Command::Measure { session: session.into(), vehicle: None, measurement }) else {
            panic!("another reply")
        };
        *answer
    }

    fn drive(&mut self, session: &str, samples: core::ops::RangeInclusive<usize>) {
        for i in samples {
            self.measure(session, engine_sample(&self.recorded.drive, i));
        }
    }

    /// A session as a server reads what another one wrote.
    fn exported(&mut self, session: &str) -> SessionImage {
        let Reply::Image(image) = self.ask(Command::Export { session: session.into() }) else { panic!("another reply") };
        session_image(&image_bytes(&image)).unwrap()
    }

    fn import(&mut self, image: SessionImage) {
        self.ask(Command::Import { image: Box::new(image), session: String::new() });
    }

    /// Buffers that were brought here.
    fn brought(&mut self) -> f64 {
        let Reply::FleetShares(_, shares) = self.ask(Command::TellFleetSoil) else { panic!("another reply") };
        shares.iter().flat_map(|share| &share.cells).map(|cell| cell.evidence.parts().buffers).sum()
    }
}

#[test]
fn property_after_a_restart_the_same_session_brings() {
    let mut before = Sharing::new();
    before.open("truck", None);
    before.drive("truck", 0..=40);
    before.ask(Command::Fork { session: "truck".into(), copy: "probe".into() });
    // A store gives the sessions back by their names, the copy first.
    let images = ["probe", "truck"].map(|session| before.exported(session));
    let mut after = Sharing::new();
    images.into_iter().for_each(|image| after.import(image));
    after.drive("probe", 41..=70);
    assert_eq!(after.brought(), 0.0);
    after.drive("truck", 41..=70);
    assert!(after.brought() > 1.0);
}

#[test]
fn property_a_copy_does_not_silence_the_session_that_comes_after() {
    let mut sharing = Sharing::new();
    sharing.open("truck", None);
    sharing.ask(Command::Fork { session: "truck".into(), copy: "probe".into() });
    sharing.ask(Command::Close { session: "truck".into() });
    sharing.open("truck", None);
    sharing.drive("truck", 0..=40);
    assert!(sharing.brought() > 1.0);
}

#[test]
fn property_a_session_that_moves_before_its_first_step_begins_from_the_fleet() {
    let mut sharing = Sharing::new();
    sharing.open("first", None);
    sharing.drive("first", 0..=70);
    sharing.open("second", None);
    let image = sharing.exported("second");
    // An older service does not say it.
    for (asks_fleet, soil_epoch) in [(true, 1), (false, 0)] {
        sharing.ask(Command::Close { session: "second".into() });
        assert!(image.asks_fleet && !image.brings_nothing);
        sharing.import(SessionImage { asks_fleet, ..image.clone() });
        let begun = sharing.measure("second", engine_sample(&sharing.recorded.drive, 0));
        assert_eq!(begun.soil.state.epoch, soil_epoch);
    }
    // Nor does one that has begun begin again.
    assert!(!sharing.exported("second").asks_fleet);
}

#[test]
fn property_a_session_that_opens_with_a_measurement_begins_from_the_fleet() {
    let mut sharing = Sharing::new();
    sharing.open("first", None);
    sharing.drive("first", 0..=70);
    let sample = engine_sample(&sharing.recorded.drive, 0);
    sharing.open("second", None);
    let expected = sharing.measure("second", sample).soil;
    assert_eq!(expected.state.epoch, 1);
    assert_eq!(sharing.open("third", Some(sample)).soil, expected);
    // What is refused changes nothing.
    let mut not_finite = engine_sample(&sharing.recorded.drive, 1);
    not_finite.state.position_m[0] = f64::NAN;
    for (measurement, label) in [(sample, "duplicate"), (not_finite, "not_finite")] {
        let refused = sharing.measure("third", measurement);
        assert_eq!((refused.outcome.label(), refused.soil), (label, expected));
    }
}

/// Answers with a soil map of as many cells as the settings allow by default.
struct Full;

#[tonic::async_trait]
impl v1::soil_server::Soil for Full {
    type WatchStream = tokio_stream::Empty<Result<v1::SoilEstimate, Status>>;

    async fn watch(&self, _: Request<v1::WatchSoilRequest>) -> Result<Response<Self::WatchStream>, Status> {
        Err(Status::unimplemented("not asked for here"))
    }

    async fn map(&self, request: Request<v1::FleetSoilRequest>) -> Result<Response<v1::FleetSoilMap>, Status> {
        let vector = v1::SoilVector { k_phi: 0.1, k_c: 0.1, n: 0.1, c_pa: 0.1, phi_rad: 0.1, k_shear_m: 0.1 };
        let cell = v1::FleetSoilCell {
            map_id: request.into_inner().map_id,
            colour_rgb: 0x80_60_40,
            column: -12,
            row: 40,
            information: vec![0.1; 36],
            vector: Some(vector),
            buffers: 0.1,
            age_s: 0.1,
        };
        let cells = vec![cell; FleetSoilSettings::default().cells_max];
        Ok(Response::new(v1::FleetSoilMap { cells, ..Default::default() }))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_full_soil_map_is_read() {
    let socket = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = format!("http://{}", socket.local_addr().unwrap());
    let router = tonic::transport::Server::builder().add_service(v1::soil_server::SoilServer::new(Full));
    let serving = tokio::spawn(router.serve_with_incoming(TcpListenerStream::new(socket)));
    let map = nesam_client::Client::connect(&address).await.unwrap().fleet_soil("quarry-7").await.unwrap();
    assert_eq!(map.cells.len(), FleetSoilSettings::default().cells_max);
    assert!(map.encoded_len() > 16 << 20, "{} bytes are more than most limits allow", map.encoded_len());
    serving.abort();
}
