//! The soil map of the fleet: as people read it, and as servers tell each other of it.

use nesam_engine::{CellEvidence, CellKey, EngineError, EvidenceParts, FleetCell, FleetShare, check_name};
use nesam_physics::SOIL_DIM;
use nesam_proto::v1 as pb;

use super::{soil_of, soil_vector};

/// The soil map of the fleet, or a part of it, as message.
pub fn fleet_soil_map(cell_m: f64, cells: &[FleetCell]) -> pb::FleetSoilMap {
    pb::FleetSoilMap { cell_m, cells: cells.iter().map(cell_message).collect() }
}

fn cell_message(cell: &FleetCell) -> pb::FleetSoilCell {
    let [red, green, blue] = cell.key.colour.map(u32::from);
    let evidence = cell.evidence.parts();
    pb::FleetSoilCell {
        map_id: cell.key.map.clone(),
        colour_rgb: red << 16 | green << 8 | blue,
        column: cell.key.cell[0],
        row: cell.key.cell[1],
        information: evidence.information.as_flattened().to_vec(),
        vector: Some(soil_vector(&evidence.vector)),
        buffers: evidence.buffers,
        age_s: cell.age_s,
    }
}

/// A server in its present life, and the bundle that its evidence of the soil belongs to: what it tells of that and takes of what others tell.
#[derive(Clone, Debug)]
pub struct SoilTeller {
    service: String,
    bundle_hash: String,
}

impl SoilTeller {
    /// Of a run of a server with a bundle.
    pub fn new(run: u64, bundle_hash: &str) -> Self {
        Self { service: format!("{run:016x}"), bundle_hash: bundle_hash.into() }
    }

    /// Name of the server in this life.
    pub fn service(&self) -> &str {
        &self.service
    }

    /// What is known here, as message.
    pub fn tell(&self, cell_m: f64, shares: &[FleetShare]) -> pb::FleetSoilShares {
        fleet_soil_shares(&self.bundle_hash, &self.service, cell_m, shares)
    }

    /// One cell of what was brought here, as message.
    pub fn tell_cell(&self, cell_m: f64, own: &FleetCell) -> pb::FleetSoilShares {
        self.tell(cell_m, &[FleetShare { service: String::new(), cells: vec![own.clone()] }])
    }

    /// What of a message is for this server: nothing of another bundle, as corrections are relative to what a bundle reads off the map, and nothing that was brought
    /// here.
    ///
    /// # Errors
    /// As [`heard_fleet_soil`].
    pub fn hear(&self, message: &pb::FleetSoilShares) -> Result<Vec<FleetShare>, EngineError> {
        if message.bundle_hash == self.bundle_hash { heard_fleet_soil(message, &self.service) } else { Ok(Vec::new()) }
    }
}

/// What was brought to servers as message; `own` is the name of this one.
pub fn fleet_soil_shares(bundle_hash: &str, own: &str, cell_m: f64, shares: &[FleetShare]) -> pb::FleetSoilShares {
    let cell = |cell: &FleetCell| {
        let evidence = cell.evidence.parts();
        pb::SharedSoilCell { cell: Some(cell_message(cell)), votes: evidence.votes, revision: evidence.revision }
    };
    let share = |share: &FleetShare| pb::FleetSoilShare {
        service: if share.service.is_empty() { own.into() } else { share.service.clone() },
        cells: share.cells.iter().map(cell).collect(),
    };
    pb::FleetSoilShares { bundle_hash: bundle_hash.into(), cell_m, shares: shares.iter().map(share).collect() }
}

/// What another server tells, without what was brought to `own`, which this server knows itself.
///
/// # Errors
/// `Invalid` naming the field at fault.
pub fn heard_fleet_soil(message: &pb::FleetSoilShares, own: &str) -> Result<Vec<FleetShare>, EngineError> {
    let told = message.shares.iter().enumerate().filter(|(_, share)| share.service != own);
    let share = |(at, share): (usize, &pb::FleetSoilShare)| {
        check_name("service", &share.service)?;
        let cells = share
            .cells
            .iter()
            .enumerate()
            .map(|(i, cell)| heard_cell(cell).map_err(|reason| EngineError::invalid(format!("shares[{at}].cells[{i}]"), reason)));
        Ok(FleetShare { service: share.service.clone(), cells: cells.collect::<Result<_, EngineError>>()? })
    };
    told.map(share).collect()
}

fn heard_cell(shared: &pb::SharedSoilCell) -> Result<FleetCell, String> {
    let cell = shared.cell.as_ref().ok_or("is empty")?;
    check_name("map_id", &cell.map_id).map_err(|error| error.to_string())?;
    let [0, red, green, blue] = cell.colour_rgb.to_be_bytes() else { return Err("its colour is no 0xRRGGBB".into()) };
    let rows: Vec<[f64; SOIL_DIM]> = cell.information.chunks_exact(SOIL_DIM).filter_map(|row| row.try_into().ok()).collect();
    let information = rows.try_into().ok().filter(|_| cell.information.len() == SOIL_DIM * SOIL_DIM);
    let parts = EvidenceParts {
        information: information.ok_or_else(|| format!("its information has {} numbers, not 36", cell.information.len()))?,
        vector: cell.vector.as_ref().map(soil_of).ok_or("it has no vector")?,
        buffers: cell.buffers,
        votes: shared.votes,
        stamp_s: 0.0,
        revision: shared.revision,
    };
    let evidence = CellEvidence::from_parts(&parts).map_err(|error| error.to_string())?;
    let key = CellKey { map: cell.map_id.clone(), colour: [red, green, blue], cell: [cell.column, cell.row] };
    Ok(FleetCell { key, evidence, age_s: cell.age_s })
}
