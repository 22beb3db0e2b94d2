//! The deadline of a request.

use std::time::Duration;

use tonic::metadata::MetadataMap;

/// Kept back from the client's deadline, so that the answer DEADLINE_EXCEEDED still arrives in time.
const MARGIN: Duration = Duration::from_millis(2);

/// Time that a request may take: the `grpc-timeout` of the client, at most `longest`.
pub fn budget(metadata: &MetadataMap, longest: Duration) -> Duration {
    let asked = metadata.get("grpc-timeout").and_then(|value| value.to_str().ok()).and_then(grpc_timeout);
    asked.map_or(longest, |asked| longest.min(asked.saturating_sub(MARGIN)))
}

/// The time that a `grpc-timeout` names: `TimeoutValue TimeoutUnit` of the gRPC protocol, up to eight digits and one of H M S m u n.
#[must_use]
pub fn grpc_timeout(text: &str) -> Option<Duration> {
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if digits.is_empty() || digits.len() > 8 || !digits.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    let value: u64 = digits.parse().ok()?;
    match unit {
        "H" => Some(Duration::from_secs(value * 3600)),
        "M" => Some(Duration::from_secs(value * 60)),
        "S" => Some(Duration::from_secs(value)),
        "m" => Some(Duration::from_millis(value)),
        "u" => Some(Duration::from_micros(value)),
        "n" => Some(Duration::from_nanos(value)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_timeout_grammar_of_grpc_over_http2() {
        for (text, expected) in [
            ("1S", Some(Duration::from_secs(1))),
            ("99999999H", Some(Duration::from_secs(99_999_999 * 3600))),
            ("20m", Some(Duration::from_millis(20))),
            ("5u", Some(Duration::from_micros(5))),
            ("", None),
            ("S", None),
            ("-1S", None),
            ("123456789S", None),
            ("1x", None),
            ("1é", None),
        ] {
            assert_eq!(grpc_timeout(text), expected, "{text}");
        }
    }

    #[test]
    fn analytic_the_shorter_deadline_counts() {
        let mut metadata = MetadataMap::new();
        let longest = Duration::from_secs(10);
        assert_eq!(budget(&metadata, longest), longest);
        metadata.insert("grpc-timeout", "1H".parse().unwrap());
        assert_eq!(budget(&metadata, longest), longest);
        metadata.insert("grpc-timeout", "100m".parse().unwrap());
        assert_eq!(budget(&metadata, longest), Duration::from_millis(98));
    }
}
