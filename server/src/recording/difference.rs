//! The first field in which two messages of one type differ, by the descriptors: the same for every message.

use prost_types::FieldDescriptorProto;
use prost_types::field_descriptor_proto::Type;

use super::schema::{Descriptors, message_of};

/// Where two messages differ, and what stands there.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct FieldDifference {
    /// Path of the field, for instance `states[37]`.
    pub field: String,
    /// What was recorded.
    pub recorded: String,
    /// What came out now.
    pub replayed: String,
}

/// A value as the wire has it.
#[derive(Clone, Copy, PartialEq)]
enum Value<'a> {
    Varint(u64),
    Fixed64([u8; 8]),
    Fixed32([u8; 4]),
    Bytes(&'a [u8]),
}

/// The first difference between two encoded messages of a type; `None` when their fields are the same.
pub(crate) fn first_difference(descriptors: &Descriptors, message: &str, recorded: &[u8], replayed: &[u8]) -> Option<FieldDifference> {
    let (Some(a), Some(b)) = (fields(recorded), fields(replayed)) else {
        return (recorded != replayed).then(|| found(String::new(), "not a message".into(), "not a message".into()));
    };
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        let (left, right) = (a.get(i), b.get(j));
        // Fields come in ascending order: the smaller number is missing on the other side.
        let number = [left, right].into_iter().flatten().map(|(number, _)| *number).min()?;
        let (left, right) = (of_number(left, number), of_number(right, number));
        if left != right {
            let seen = a[..i].iter().filter(|(n, _)| *n == number).count();
            return Some(of_field(descriptors, message, number, seen, left, right));
        }
        i += usize::from(left.is_some());
        j += usize::from(right.is_some());
    }
    None
}

fn of_number<'a>(side: Option<&(u32, Value<'a>)>, number: u32) -> Option<Value<'a>> {
    side.filter(|(n, _)| *n == number).map(|(_, value)| *value)
}

fn found(field: String, recorded: String, replayed: String) -> FieldDifference {
    FieldDifference { field, recorded, replayed }
}

/// The difference within one field; `seen` elements of it came before.
fn of_field(
    descriptors: &Descriptors,
    message: &str,
    number: u32,
    seen: usize,
    left: Option<Value<'_>>,
    right: Option<Value<'_>>,
) -> FieldDifference {
    let field = descriptors.field(message, number);
    let name = field.map_or_else(|| format!("field {number}"), |field| field.name().to_string());
    let repeated = field.is_some_and(|field| field.label() == prost_types::field_descriptor_proto::Label::Repeated);
    let name_at = |index: usize| format!("{name}[{index}]");
    if let (Some(Value::Bytes(a)), Some(Value::Bytes(b))) = (left, right) {
        if let Some(inner) = field.and_then(message_of) {
            let name = if repeated { name_at(seen) } else { name.clone() };
            if let Some(deeper) = first_difference(descriptors, inner, a, b) {
                return found(format!("{name}.{}", deeper.field), deeper.recorded, deeper.replayed);
            }
        } else if let Some(width) = field.and_then(element_bytes) {
            return of_packed(field, &name, width, a, b);
        }
    }
    let name = if repeated { name_at(seen) } else { name };
    let shown = |value: Option<Value<'_>>| value.map_or("absent".into(), |value| show(field, value));
    found(name, shown(left), shown(right))
}

/// Bytes of one element of a packed field. Fields of type `bytes` hold packed f32 in this interface.
fn element_bytes(field: &FieldDescriptorProto) -> Option<usize> {
    match field.r#type() {
        Type::Bytes | Type::Float | Type::Fixed32 | Type::Sfixed32 => Some(4),
        Type::Double | Type::Fixed64 | Type::Sfixed64 => Some(8),
        _ => None,
    }
}

fn of_packed(field: Option<&FieldDescriptorProto>, name: &str, width: usize, a: &[u8], b: &[u8]) -> FieldDifference {
    if a.len() != b.len() {
        return found(name.into(), format!("{} bytes", a.len()), format!("{} bytes", b.len()));
    }
    let at = a.iter().zip(b).position(|(x, y)| x != y).unwrap_or(0) / width;
    let element = |bytes: &[u8]| {
        let element = bytes.chunks(width).nth(at).unwrap_or_default();
        match (<[u8; 8]>::try_from(element), <[u8; 4]>::try_from(element)) {
            (Ok(eight), _) => show(field, Value::Fixed64(eight)),
            (_, Ok(four)) => show(field, Value::Fixed32(four)),
            _ => format!("{element:?}"),
        }
    };
    found(format!("{name}[{at}]"), element(a), element(b))
}

/// A value as a person reads it.
fn show(field: Option<&FieldDescriptorProto>, value: Value<'_>) -> String {
    let kind = field.map(FieldDescriptorProto::r#type);
    match value {
        Value::Varint(v) if matches!(kind, Some(Type::Int64 | Type::Int32 | Type::Enum)) => (v as i64).to_string(),
        Value::Varint(v) => v.to_string(),
        Value::Fixed64(bytes) => format!("{:?}", f64::from_le_bytes(bytes)),
        Value::Fixed32(bytes) => format!("{:?}", f32::from_le_bytes(bytes)),
        Value::Bytes(bytes) if kind == Some(Type::String) => format!("{:?}", String::from_utf8_lossy(bytes)),
        Value::Bytes(_) if kind == Some(Type::Message) => "present".into(),
        Value::Bytes(bytes) => format!("{} bytes", bytes.len()),
    }
}

/// The fields of an encoded message in their order; `None` when it is not one.
fn fields(mut data: &[u8]) -> Option<Vec<(u32, Value<'_>)>> {
    let mut fields = Vec::new();
    while !data.is_empty() {
        let key = varint(&mut data)?;
        let value = match key & 7 {
            0 => Value::Varint(varint(&mut data)?),
            1 => Value::Fixed64(take(&mut data, 8)?.try_into().ok()?),
            2 => {
                let length = usize::try_from(varint(&mut data)?).ok()?;
                Value::Bytes(take(&mut data, length)?)
            }
            5 => Value::Fixed32(take(&mut data, 4)?.try_into().ok()?),
            _ => return None,
        };
        fields.push((u32::try_from(key >> 3).ok()?, value));
    }
    Some(fields)
}

fn take<'a>(data: &mut &'a [u8], count: usize) -> Option<&'a [u8]> {
    let (taken, rest) = data.split_at_checked(count)?;
    *data = rest;
    Some(taken)
}

/// A base-128 integer, least significant group first.
fn varint(data: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for group in 0..10 {
        let byte = *take(data, 1)?.first()?;
        value |= u64::from(byte & 0x7f) << (7 * group);
        if byte & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use nesam_proto::v1 as pb;

    use super::*;

    fn difference<M: prost::Message>(kind: &str, a: &M, b: &M) -> Option<(String, String, String)> {
        let found = first_difference(&Descriptors::of_program(), &format!("nesam.v1.{kind}"), &a.encode_to_vec(), &b.encode_to_vec())?;
        Some((found.field, found.recorded, found.replayed))
    }

    fn named(field: &str, recorded: &str, replayed: &str) -> Option<(String, String, String)> {
        Some((field.into(), recorded.into(), replayed.into()))
    }

    #[test]
    fn analytic_the_first_difference_is_named() {
        let packed = |values: [f32; 3]| crate::convert::encode(&values, crate::convert::Precision::F32);
        let base = pb::PredictReply { states: packed([1.0, 2.0, 3.0]), validity: vec![4, 0], ..Default::default() };
        assert_eq!(difference("PredictReply", &base, &base), None);
        let states = pb::PredictReply { states: packed([1.0, 2.5, -3.0]), ..base.clone() };
        assert_eq!(difference("PredictReply", &base, &states), named("states[1]", "2.0", "2.5"));
        let shorter = pb::PredictReply { states: base.states.slice(..8), ..base.clone() };
        assert_eq!(difference("PredictReply", &base, &shorter), named("states", "12 bytes", "8 bytes"));
        let provenance = pb::PredictReply { provenance: Some(pb::Provenance { soil_epoch: 3, ..Default::default() }), ..base.clone() };
        assert_eq!(difference("PredictReply", &base, &provenance), named("provenance", "absent", "present"));
        let other = pb::PredictReply { provenance: Some(pb::Provenance { map_id: "m".into(), ..Default::default() }), ..base };
        assert_eq!(difference("PredictReply", &provenance, &other), named("provenance.soil_epoch", "3", "absent"));
    }

    #[test]
    fn analytic_repeated_messages_and_doubles_are_counted() {
        let session = |x: f64| pb::Session {
            session_id: "s".into(),
            soil_correction: Some(pb::SoilCorrection { covariance: vec![0.5, x], ..Default::default() }),
            ..Default::default()
        };
        let list = |x: f64| pb::ListSessionsReply { sessions: vec![session(1.0), session(x)] };
        assert_eq!(
            difference("ListSessionsReply", &list(1.0), &list(-1.0)),
            named("sessions[1].soil_correction.covariance[1]", "1.0", "-1.0")
        );
    }
}
