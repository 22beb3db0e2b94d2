//! nesam.v1.Terrain.

use std::time::Duration;

use nesam_engine::EngineError;
use nesam_proto::v1 as pb;
use nesam_terrain::WorldMap;
use pb::upload_map_request::Part;
use tonic::{Request, Response, Status, Streaming};

use super::Edge;
use crate::access::{Caller, Wish};
use crate::convert::{MapBuilder, description, patched, to_status};
use crate::store::Key;
use crate::telemetry::Transport;

/// Takes and describes maps.
pub struct Service(pub Edge);

/// Reads the header and the tiles of an upload.
async fn receive(edge: &Edge, caller: &Caller, mut inbound: Streaming<pb::UploadMapRequest>) -> Result<MapBuilder, Status> {
    let missing = || to_status(EngineError::invalid("header", "is missing; the first message must be the header"));
    let first = inbound.message().await?.and_then(|message| message.part);
    let Some(Part::Header(header)) = first else { return Err(missing()) };
    caller.may(Wish::ChangeMap(&header.map_id))?;
    caller.changes(Wish::ChangeMap(&header.map_id));
    let mut builder = MapBuilder::new(&header, edge.engine.handle().limits()).map_err(to_status)?;
    while let Some(message) = inbound.message().await? {
        match message.part {
            Some(Part::Tile(tile)) => builder.add(&tile).map_err(to_status)?,
            Some(Part::Header(_)) => return Err(to_status(EngineError::invalid("header", "comes twice"))),
            None => return Err(to_status(EngineError::invalid("tile", "is missing"))),
        }
    }
    Ok(builder)
}

/// Runs work that takes long off the network's threads.
async fn off_thread(work: impl FnOnce() -> Result<WorldMap, EngineError> + Send + 'static) -> Result<WorldMap, Status> {
    let result = tokio::task::spawn_blocking(work).await;
    result.unwrap_or_else(|_| Err(EngineError::Internal { reason: "making a map panicked".into() })).map_err(to_status)
}

#[tonic::async_trait]
impl pb::terrain_server::Terrain for Service {
    async fn upload_map(&self, request: Request<Streaming<pb::UploadMapRequest>>) -> Result<Response<pb::MapDescription>, Status> {
        let edge = &self.0;
        edge.engine.metrics().request(Transport::Grpc, "upload_map");
        let caller = edge.access.caller(&request)?;
        let _permit = edge.uploads.try_acquire().map_err(|_| {
            let reason = format!("{} uploads run, the limit; try again later", edge.config.uploads_max);
            to_status(EngineError::Exhausted { field: "uploads".into(), reason })
        })?;
        let limit = Duration::from_secs_f64(edge.config.upload_deadline_s);
        let builder = tokio::time::timeout(limit, receive(edge, &caller, request.into_inner()))
            .await
            .map_err(|_| Status::deadline_exceeded(format!("the upload took longer than {} s", edge.config.upload_deadline_s)))??;
        let map = off_thread(move || builder.finish()).await?;
        // Another server may have a newer version.
        edge.bring_map(map.id(), edge.stream_budget()).await?;
        let map = edge.engine.put_map(map.into(), None, edge.stream_budget()).await.map_err(to_status)?;
        tracing::info!(map = map.id(), version = map.version(), cells = map.geometry().cells(), "map uploaded");
        edge.settled(Key::Map(map.id().into()), edge.stream_budget()).await?;
        Ok(Response::new(description(&map)))
    }

    async fn patch_tile(&self, request: Request<pb::PatchTileRequest>) -> Result<Response<pb::MapDescription>, Status> {
        let edge = &self.0;
        edge.engine.metrics().request(Transport::Grpc, "patch_tile");
        edge.allow(&request, Wish::ChangeMap(&request.get_ref().map_id)).await?;
        let budget = edge.budget(&request);
        let message = request.into_inner();
        let tile = message.tile.ok_or_else(|| to_status(EngineError::invalid("tile", "is missing")))?;
        edge.bring_map(&message.map_id, budget).await?;
        let held = edge.engine.get_map(&message.map_id, budget).await.map_err(to_status)?;
        let base = message.base_version;
        if held.version() != base {
            return Err(to_status(EngineError::MapChanged { map: message.map_id, held: held.version(), base }));
        }
        let map = off_thread(move || patched(&held, &tile)).await?;
        let map = edge.engine.put_map(map.into(), Some(base), budget).await.map_err(to_status)?;
        edge.settled(Key::Map(map.id().into()), budget).await?;
        Ok(Response::new(description(&map)))
    }

    async fn get(&self, request: Request<pb::GetMapRequest>) -> Result<Response<pb::MapDescription>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "get_map");
        self.0.access.caller(&request)?;
        self.0.bring_map(&request.get_ref().map_id, self.0.budget(&request)).await?;
        let map = self.0.engine.get_map(&request.get_ref().map_id, self.0.budget(&request)).await.map_err(to_status)?;
        Ok(Response::new(description(&map)))
    }

    async fn list(&self, request: Request<pb::ListMapsRequest>) -> Result<Response<pb::ListMapsReply>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "list_maps");
        self.0.access.caller(&request)?;
        let maps = self.0.engine.list_maps(self.0.budget(&request)).await.map_err(to_status)?;
        Ok(Response::new(pb::ListMapsReply { maps: maps.iter().map(|map| description(map)).collect() }))
    }

    async fn delete(&self, request: Request<pb::DeleteMapRequest>) -> Result<Response<pb::DeleteMapReply>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "delete_map");
        let budget = self.0.budget(&request);
        self.0.allow(&request, Wish::ChangeMap(&request.get_ref().map_id)).await?;
        let map = request.into_inner().map_id;
        self.0.bring_map(&map, budget).await?;
        if let Some(cluster) = &self.0.cluster
            && let Some(session) = cluster.map_user(&map).await?
        {
            return Err(to_status(EngineError::MapInUse { map, session }));
        }
        self.0.engine.delete_map(&map, budget).await.map_err(to_status)?;
        self.0.settled(Key::Map(map), budget).await?;
        Ok(Response::new(pb::DeleteMapReply {}))
    }
}
