//! Alarms, and the watch behind them in an exported session.

use nesam_engine::{Alarm, AlarmKind, EngineError, WatchImage};
use nesam_proto::v1 as pb;

/// An alarm of a session as message.
pub fn alarm_message(session: &str, vehicle: &str, alarm: &Alarm) -> pb::Alarm {
    let kind = match alarm.kind {
        AlarmKind::NisLarge => pb::AlarmKind::NisLarge,
        AlarmKind::NisSmall => pb::AlarmKind::NisSmall,
        AlarmKind::Correlated => pb::AlarmKind::Correlated,
        AlarmKind::MotionJump => pb::AlarmKind::MotionJump,
        AlarmKind::SensorJump => pb::AlarmKind::SensorJump,
    };
    pb::Alarm {
        session_id: session.into(),
        vehicle_id: vehicle.into(),
        episode: alarm.episode,
        active: alarm.active,
        kind: kind.into(),
        channel: alarm.channel_name().into(),
        size: alarm.size,
        statistic: alarm.statistic,
        threshold: alarm.threshold,
        stamp_ns: alarm.stamp_ns,
        onset_stamp_ns: alarm.onset_ns,
        description: alarm.description(),
        diagnose: alarm.diagnose(session),
        soil_share: alarm.soil_share,
    }
}

/// A watch as part of an exported session.
pub(super) fn watch_image(watch: &WatchImage) -> pb::WatchImage {
    pb::WatchImage {
        values: watch.values.as_flattened().to_vec(),
        begin_ns: watch.stamps_ns.iter().map(|stamps| stamps[0]).collect(),
        end_ns: watch.stamps_ns.iter().map(|stamps| stamps[1]).collect(),
        episodes: watch.episodes,
        active: watch.active.as_ref().map(|alarm| pb::EpisodeImage {
            kind: AlarmKind::ALL.iter().position(|kind| *kind == alarm.kind).map_or(0, |place| place as u32 + 1),
            channel: alarm.channel.map_or(0, |channel| channel as u32 + 1),
            size: alarm.size,
            statistic: alarm.statistic,
            threshold: alarm.threshold,
            stamp_ns: alarm.stamp_ns,
            onset_stamp_ns: alarm.onset_ns,
            soil_share: alarm.soil_share,
        }),
        calm: watch.calm,
    }
}

/// The inverse of [`watch_image`].
///
/// # Errors
/// `Invalid` naming `image` when it is not of the shape of a watch.
pub(super) fn from_watch_image(watch: &pb::WatchImage) -> Result<WatchImage, EngineError> {
    let refused = || EngineError::invalid("image", "has a watch of another shape");
    let (rows, rest) = watch.values.as_chunks::<{ WatchImage::VALUES }>();
    if !rest.is_empty() || rows.len() != watch.begin_ns.len() || rows.len() != watch.end_ns.len() {
        return Err(refused());
    }
    let active: Option<Result<Alarm, EngineError>> = watch.active.as_ref().map(|episode| {
        let place = usize::try_from(episode.kind).ok().and_then(|number| number.checked_sub(1));
        let kind = place.and_then(|place| AlarmKind::ALL.get(place)).copied().ok_or_else(refused)?;
        Ok(Alarm {
            episode: watch.episodes,
            active: true,
            kind,
            channel: (episode.channel as usize).checked_sub(1),
            size: episode.size,
            statistic: episode.statistic,
            threshold: episode.threshold,
            soil_share: episode.soil_share,
            stamp_ns: episode.stamp_ns,
            onset_ns: episode.onset_stamp_ns,
        })
    });
    Ok(WatchImage {
        stamps_ns: watch.begin_ns.iter().zip(&watch.end_ns).map(|(begin, end)| [*begin, *end]).collect(),
        values: rows.to_vec(),
        episodes: watch.episodes,
        active: active.transpose()?,
        calm: watch.calm,
    })
}
