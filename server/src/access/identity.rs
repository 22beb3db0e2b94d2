//! Who a certificate says that a client is.

use nesam_engine::check_name;
use tonic::transport::CertificateDer;
use webpki::EndEntityCert;

/// Beginning of the subject alternative name (URI) that carries the identity: `nesam:<role>:<name>`.
const SCHEME: &str = "nesam";

/// What a client is.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Identity {
    /// The vehicle of this id.
    Vehicle(String),
    /// A planner.
    Planner(String),
    /// Somebody who may do everything.
    Operator(String),
    /// A server of the fleet, towards Zenoh routers.
    Server(String),
    /// A proxy that ends TLS and says with each call for whom it is.
    Proxy(String),
}

impl Identity {
    /// Role and name.
    fn parts(&self) -> (&'static str, &str) {
        match self {
            Self::Vehicle(name) => ("vehicle", name),
            Self::Planner(name) => ("planner", name),
            Self::Operator(name) => ("operator", name),
            Self::Server(name) => ("server", name),
            Self::Proxy(name) => ("proxy", name),
        }
    }

    /// `nesam:vehicle:truck-7` and the like: the subject alternative name over gRPC, the common name over Zenoh.
    pub fn uri(&self) -> String {
        let (role, name) = self.parts();
        format!("{SCHEME}:{role}:{name}")
    }
}

impl core::fmt::Display for Identity {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (role, name) = self.parts();
        write!(f, "{role} `{name}`")
    }
}

impl Identity {
    /// Reads `nesam:vehicle:truck-7` and the like.
    ///
    /// # Errors
    /// What is wrong with the text.
    pub fn parse(uri: &str) -> Result<Self, String> {
        let parts: Vec<&str> = uri.split(':').collect();
        let [SCHEME, role, name] = parts.as_slice() else { return Err(format!("`{uri}` is not nesam:<role>:<name>")) };
        check_name("name", name).map_err(|error| format!("`{uri}`: {error}"))?;
        match *role {
            "vehicle" => Ok(Self::Vehicle((*name).into())),
            "planner" => Ok(Self::Planner((*name).into())),
            "operator" => Ok(Self::Operator((*name).into())),
            "server" => Ok(Self::Server((*name).into())),
            "proxy" => Ok(Self::Proxy((*name).into())),
            _ => Err(format!("`{uri}`: roles are vehicle, planner, operator, server and proxy")),
        }
    }

    /// The identity in a certificate that the TLS layer has verified. A certificate that names two is refused: which one would count?
    ///
    /// # Errors
    /// What is wrong with the certificate.
    pub fn of_certificate(certificate: &CertificateDer<'_>) -> Result<Self, String> {
        let certificate = EndEntityCert::try_from(certificate).map_err(|error| format!("the certificate is not readable: {error}"))?;
        let mut names = certificate.valid_uri_names().filter(|uri| uri.split(':').next() == Some(SCHEME));
        match (names.next(), names.next()) {
            (Some(uri), None) => Self::parse(uri),
            (None, _) => Err("the certificate has no subject alternative name URI nesam:<role>:<name>".into()),
            (Some(_), Some(_)) => Err("the certificate names more than one identity".into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_names_are_read_strictly() {
        assert_eq!(Identity::parse("nesam:vehicle:truck-7"), Ok(Identity::Vehicle("truck-7".into())));
        assert_eq!(Identity::parse("nesam:operator:x").map(|i| i.to_string()), Ok("operator `x`".into()));
        assert_eq!(Identity::parse("nesam:server:alpha").map(|i| i.uri()), Ok("nesam:server:alpha".into()));
        for wrong in ["nesam:vehicle", "nesam:vehicle:a:b", "nesam:king:a", "nesam:vehicle:", "nesam:vehicle:a/b", "other:vehicle:a", ""] {
            assert!(Identity::parse(wrong).is_err(), "{wrong}");
        }
    }
}
