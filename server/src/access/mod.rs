//! Who may do what.
//!
//! With `tls.client_ca` every client shows a certificate that the CA has signed; its subject alternative name `nesam:<role>:<name>` is who it is, and the
//! fleet file says what that one may do. Both are read again when they change. Every handler asks [`Access`] before the engine does; what is refused and who
//! changes what is logged under the target `nesam::audit`. Without `tls.client_ca` everybody may do everything, and the server says so when it starts.

pub(crate) mod certificate;
mod credentials;
mod directory;
mod fleet_file;
mod identity;
mod refusals;
mod rereading;

use std::net::SocketAddr;
use std::sync::Arc;

use nesam_engine::Shown;
use tokio::sync::watch;
use tonic::metadata::MetadataMap;
use tonic::{Request, Status};

pub use self::credentials::Credentials;
pub(crate) use self::credentials::{TlsFiles, certificates};
pub use self::directory::Directory;
pub use self::fleet_file::FleetFile;
pub use self::identity::Identity;
pub use self::refusals::{Refusal, Refusals};
pub(crate) use self::rereading::{Rereading, read_file, reread};
use crate::config::TlsConfig;
use crate::error::ServerError;

/// Metadata in which a proxy that ends TLS says for whom a call is: `nesam:<role>:<name>`. Of anybody else it means nothing.
const ON_BEHALF_OF: &str = "x-nesam-identity";

/// What a caller wants to do with a session, a vehicle or a map.
#[derive(Clone, Copy, Debug)]
pub enum Wish<'a> {
    /// Read an open session, or predict from it.
    ReadSession(&'a str),
    /// Feed, copy or close an open session.
    ChangeSession(&'a str),
    /// Open a session of a vehicle under a name.
    OpenSession {
        /// Vehicle that the session is to belong to.
        vehicle: &'a str,
        /// Name of the session; empty = the vehicle's.
        session: &'a str,
    },
    /// Put effects on the vehicle of an open session, or take them away.
    ApplyEffects(&'a str),
    /// Diagnose what was recorded of a session, which need not be open any more.
    Diagnose(&'a str),
    /// Upload, patch or delete a map.
    ChangeMap(&'a str),
}

/// Decides.
#[derive(Clone, Debug, Default)]
pub struct Access {
    /// `None` = no client certificates: everybody may do everything.
    fleet: Option<watch::Receiver<Arc<FleetFile>>>,
    /// Whose session is whose.
    pub directory: Directory,
    /// What was refused.
    pub refusals: Refusals,
}

/// Whoever sent a request.
#[derive(Clone, Debug)]
pub struct Caller {
    access: Access,
    /// `None` = without client certificates.
    identity: Option<Identity>,
    /// Where the connection comes from.
    peer: Option<SocketAddr>,
}

/// TLS of the server and the rights of its clients, from the files of a configuration; `None` = without TLS.
///
/// # Errors
/// `ServerError::Tls` naming the key whose file cannot be used.
pub fn load(config: &TlsConfig) -> Result<(Option<Credentials>, Access), ServerError> {
    if config.certificate.as_os_str().is_empty() {
        return Ok((None, Access::default()));
    }
    let credentials = Credentials::read(config)?;
    let access = Access { fleet: credentials.rights(), ..Access::default() };
    Ok((Some(credentials), access))
}

impl<'a> Wish<'a> {
    /// The session that has to be open for it.
    pub fn session(self) -> Option<&'a str> {
        match self {
            Self::ReadSession(session) | Self::ChangeSession(session) | Self::ApplyEffects(session) => Some(session),
            Self::OpenSession { .. } | Self::Diagnose(_) | Self::ChangeMap(_) => None,
        }
    }
}

impl Access {
    /// Whether clients have identities.
    pub fn is_restricted(&self) -> bool {
        self.fleet.is_some()
    }

    /// The rights in force, where clients have identities.
    pub fn rights(&self) -> Option<Arc<FleetFile>> {
        self.fleet.as_ref().map(|fleet| fleet.borrow().clone())
    }

    /// Who sent a request; behind a proxy, whom it names.
    ///
    /// # Errors
    /// UNAUTHENTICATED when the certificate or the proxy names nobody, PERMISSION_DENIED when it is nobody of the fleet.
    pub fn caller<T>(&self, request: &Request<T>) -> Result<Caller, Status> {
        let from = |identity| Caller { access: self.clone(), identity, peer: request.remote_addr() };
        let Some(fleet) = self.rights() else { return Ok(from(None)) };
        let certificates = request.peer_certs().unwrap_or_default();
        let shown = match certificates.first() {
            Some(certificate) => Identity::of_certificate(certificate),
            None => Err("the client shows no certificate".into()),
        };
        let peer = || request.remote_addr().map(|address| address.to_string()).unwrap_or_default();
        let refused = |_: &Status| self.refusals.count(Refusal::Identity);
        let mut identity = member(&fleet, shown, peer).inspect_err(refused)?;
        if let Identity::Proxy(_) = identity {
            identity = member(&fleet, behind(&identity, request.metadata()), peer).inspect_err(refused)?;
        }
        Ok(from(Some(identity)))
    }
}

/// Somebody who is in the fleet file.
fn member(fleet: &FleetFile, identity: Result<Identity, String>, peer: impl Fn() -> String) -> Result<Identity, Status> {
    let identity = identity.map_err(|reason| {
        tracing::warn!(target: "nesam::audit", peer = peer(), reason, "refused: no identity");
        Status::unauthenticated(reason)
    })?;
    if !fleet.knows(&identity) {
        tracing::warn!(target: "nesam::audit", %identity, "refused: not in the fleet file");
        return Err(Status::permission_denied(format!("{identity} is not in the fleet file of this server")));
    }
    Ok(identity)
}

/// For whom a proxy calls.
fn behind(proxy: &Identity, metadata: &MetadataMap) -> Result<Identity, String> {
    let mut values = metadata.get_all(ON_BEHALF_OF).iter();
    let (Some(value), None) = (values.next(), values.next()) else {
        return Err(format!("{proxy} has to say in `{ON_BEHALF_OF}` for whom it calls, once"));
    };
    match Identity::parse(value.to_str().map_err(|_| format!("`{ON_BEHALF_OF}` is no text"))?)? {
        Identity::Proxy(_) => Err(format!("{proxy} calls for another proxy")),
        identity => Ok(identity),
    }
}

impl Caller {
    /// Whether the caller may; where there are identities, the vehicle of the session that the wish is about.
    ///
    /// # Errors
    /// PERMISSION_DENIED, or NOT_FOUND for a session that is not open: then there is nobody whose it could be.
    pub fn may(&self, wish: Wish<'_>) -> Result<Option<Arc<str>>, Status> {
        // Without identities the engine says what is not there.
        let Some((fleet, identity)) = self.known() else { return Ok(None) };
        self.decide(&fleet, identity, wish, self.vehicle_of(wish))
    }

    /// The same for a session of this vehicle that is not open here.
    ///
    /// # Errors
    /// PERMISSION_DENIED.
    pub fn may_with(&self, wish: Wish<'_>, vehicle: &str) -> Result<(), Status> {
        let Some((fleet, identity)) = self.known() else { return Ok(()) };
        self.decide(&fleet, identity, wish, Some(vehicle.into())).map(drop)
    }

    /// Tells the log that the caller changes something and may. Not for single measurements.
    pub fn changes(&self, wish: Wish<'_>) {
        let by = self.identity.as_ref().map_or_else(|| "anybody".into(), ToString::to_string);
        let peer = self.peer.map(|peer| peer.to_string()).unwrap_or_default();
        tracing::info!(target: "nesam::audit", by, peer, "allowed: {wish}");
    }

    /// Resolves when the caller, who had it, has lost a right; never where there are no identities.
    pub async fn loses(&self, wish: Wish<'_>) -> Status {
        let Some(mut fleet) = self.access.fleet.clone() else { return std::future::pending().await };
        loop {
            // A session that is gone is nobody's: that is told otherwise.
            match self.may(wish) {
                Err(status) if status.code() == tonic::Code::PermissionDenied => return status,
                _ => {}
            }
            if fleet.changed().await.is_err() {
                return std::future::pending().await;
            }
        }
    }

    /// The rights in force and who the caller is, where clients have identities.
    fn known(&self) -> Option<(Arc<FleetFile>, &Identity)> {
        self.access.rights().zip(self.identity.as_ref())
    }

    /// Whether the caller may read the sessions of a vehicle; nothing is logged.
    pub fn sees(&self, vehicle: &str) -> bool {
        self.known().is_none_or(|(fleet, identity)| fleet.may_read(identity, vehicle))
    }

    fn vehicle_of(&self, wish: Wish<'_>) -> Option<Arc<str>> {
        wish.session().and_then(|session| self.access.directory.vehicle(session))
    }

    /// Whether somebody may, with a session of this vehicle; what is refused is logged and counted.
    fn decide(
        &self,
        fleet: &FleetFile,
        identity: &Identity,
        wish: Wish<'_>,
        vehicle: Option<Arc<str>>,
    ) -> Result<Option<Arc<str>>, Status> {
        let allowed = match (wish, &vehicle) {
            (Wish::ReadSession(session) | Wish::ChangeSession(session) | Wish::ApplyEffects(session), None) => {
                return Err(crate::convert::to_status(nesam_engine::EngineError::UnknownSession { session: session.into() }));
            }
            (Wish::ReadSession(_), Some(vehicle)) => fleet.may_read(identity, vehicle),
            (Wish::ApplyEffects(_), Some(_)) | (Wish::Diagnose(_), _) => fleet.may_operate(identity),
            (Wish::ChangeSession(_), Some(vehicle)) => fleet.may_change(identity, vehicle),
            (Wish::OpenSession { vehicle, session }, _) => {
                let name = if session.is_empty() { vehicle } else { session };
                fleet.may_change(identity, vehicle) && fleet.may_name(identity, name)
            }
            (Wish::ChangeMap(map), _) => fleet.may_change_map(identity, map),
        };
        if allowed {
            return Ok(vehicle);
        }
        tracing::warn!(target: "nesam::audit", %identity, %wish, "refused: no right");
        self.access.refusals.count(Refusal::Right);
        Err(Status::permission_denied(format!("{identity} has no right to {wish}; the fleet file of the server gives rights")))
    }
}

impl core::fmt::Display for Wish<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::ReadSession(session) => write!(f, "read session `{}`", Shown(session)),
            Self::ApplyEffects(session) => write!(f, "change the effects of session `{}`", Shown(session)),
            Self::Diagnose(session) => write!(f, "diagnose session `{}`", Shown(session)),
            Self::ChangeSession(session) => write!(f, "change session `{}`", Shown(session)),
            Self::OpenSession { vehicle, session } => write!(f, "open session `{}` of vehicle `{}`", Shown(session), Shown(vehicle)),
            Self::ChangeMap(map) => write!(f, "change map `{}`", Shown(map)),
        }
    }
}
