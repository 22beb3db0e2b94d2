//! The topics of a recording: one for each kind of message.

/// What a message is in its command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Part of what was asked.
    Request,
    /// The answer, which ends the command.
    Answer,
    /// For viewers only; no part of any command.
    View,
}

macro_rules! topics {
    ($($name:ident $role:ident $topic:literal $message:literal,)*) => {
        /// A topic.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[allow(missing_docs)]
        pub enum Topic {
            $(#[doc = concat!("`", $topic, "`: nesam.v1.", $message)] $name,)*
        }

        impl Topic {
            /// All of them.
            pub const ALL: &[Self] = &[$(Self::$name,)*];

            /// Name in the file.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$name => $topic,)*
                }
            }

            /// Full name of its message type.
            pub fn message(self) -> &'static str {
                match self {
                    $(Self::$name => concat!("nesam.v1.", $message),)*
                }
            }

            /// What its messages are in a command.
            pub(crate) fn role(self) -> Role {
                match self {
                    $(Self::$name => Role::$role,)*
                }
            }
        }
    };
}

topics! {
    Open Request "/session/open" "OpenSessionRequest",
    Get Request "/session/get" "GetSessionRequest",
    List Request "/session/list" "ListSessionsRequest",
    Fork Request "/session/fork" "ForkSessionRequest",
    Export Request "/session/export" "ExportSessionRequest",
    Import Request "/session/import" "ImportSessionRequest",
    Close Request "/session/close" "CloseSessionRequest",
    ApplyEffects Request "/session/effects/apply" "ApplyEffectsRequest",
    RevertEffects Request "/session/effects/revert" "RevertEffectsRequest",
    Expire Request "/session/expire" "ExpireSessionsRequest",
    MeasurementSource Request "/measurement/source" "MeasurementSource",
    Measurement Request "/measurement" "Measurement",
    FleetSoil Request "/fleet_soil/read" "FleetSoilRequest",
    FleetSoilShares Request "/fleet_soil/told" "FleetSoilShares",
    Predict Request "/predict" "PredictRequest",
    MapUpload Request "/map/upload" "UploadMapRequest",
    MapPatch Request "/map/patch" "PatchTileRequest",
    MapGet Request "/map/get" "GetMapRequest",
    MapList Request "/map/list" "ListMapsRequest",
    MapDelete Request "/map/delete" "DeleteMapRequest",
    Session Answer "/session" "Session",
    Exported Answer "/session/exported" "ExportSessionReply",
    Sessions Answer "/sessions" "ListSessionsReply",
    Closed Answer "/session/closed" "CloseSessionReply",
    Expired Answer "/session/expired" "ExpireSessionsReply",
    MeasurementAnswer Answer "/measurement/answer" "MeasurementAnswer",
    FleetSoilMap Answer "/fleet_soil" "FleetSoilMap",
    FleetSoilHeard Answer "/fleet_soil/heard" "FleetSoilHeard",
    Prediction Answer "/prediction" "PredictReply",
    PredictionError Answer "/prediction/error" "PredictError",
    Map Answer "/map" "MapDescription",
    Maps Answer "/maps" "ListMapsReply",
    MapDeleted Answer "/map/deleted" "DeleteMapReply",
    Refused Answer "/refused" "Refusal",
    Soil View "/soil" "SoilEstimate",
}

impl Topic {
    /// The topic of a name.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|topic| topic.name() == name)
    }
}
