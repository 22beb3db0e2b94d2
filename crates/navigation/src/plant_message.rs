//! Datagrams of a plant as they are written elsewhere.

use serde_json::Value;

/// Numbers that JSON does not know and languages write nevertheless: Python's `json.dumps`, C's `printf`. A longer one stands before its beginning.
const BARE: [&str; 8] = ["-Infinity", "Infinity", "-NaN", "NaN", "-nan", "nan", "-inf", "inf"];

/// A datagram as JSON, with null for numbers that are none; `None` where it is no JSON even so.
pub fn read_json(datagram: &[u8]) -> Option<Value> {
    let text = std::str::from_utf8(datagram).ok()?;
    serde_json::from_str(text).or_else(|_| serde_json::from_str(&with_nulls(text))).ok()
}

/// The text with null for each of [`BARE`] that stands outside of strings.
fn with_nulls(text: &str) -> String {
    let (mut written, mut rest) = (String::with_capacity(text.len()), text);
    let (mut quoted, mut escaped) = (false, false);
    while let Some(c) = rest.chars().next() {
        if !quoted && let Some(after) = BARE.iter().find_map(|bare| rest.strip_prefix(*bare)) {
            written.push_str("null");
            rest = after;
            continue;
        }
        quoted ^= c == '"' && !escaped;
        escaped = c == '\\' && !escaped;
        written.push(c);
        rest = &rest[c.len_utf8()..];
    }
    written
}

/// Twelve numbers; a null is NaN, and so are all of a null in their place.
pub fn twelve(value: &Value) -> Option<[f64; 12]> {
    let number = |v: &Value| if v.is_null() { Some(f64::NAN) } else { v.as_f64() };
    match value {
        Value::Null => Some([f64::NAN; 12]),
        Value::Array(values) => values.iter().map(number).collect::<Option<Vec<f64>>>()?.try_into().ok(),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: numbers that are none are read as such, and texts that speak of them stay. Method: what Python writes of them, and what JSON does not forgive.
    #[test]
    fn property_bare_words_for_numbers_that_are_none_are_nulls() {
        let read = read_json(br#"{"id": 3, "state": [NaN, -Infinity, Infinity, nan, 1.5], "ended": "a \"NaN\" \\", "x": NaN}"#).unwrap();
        assert_eq!(read.to_string(), r#"{"ended":"a \"NaN\" \\","id":3,"state":[null,null,null,null,1.5],"x":null}"#);
        for garbage in [&b"hello?"[..], b"", b"{\"id\": None}", b"\xff", b"{\"id\": NaN"] {
            assert!(read_json(garbage).is_none(), "{garbage:?}");
        }
    }

    #[test]
    fn property_a_state_has_twelve_numbers() {
        let state = |count: usize| Value::from(vec![0.5; count]);
        assert!(twelve(&state(12)) == Some([0.5; 12]) && twelve(&state(13)).is_none() && twelve(&state(0)).is_none());
        assert!(twelve(&Value::Null).unwrap().iter().all(|v| v.is_nan()));
        let mut mixed = state(12);
        mixed[4] = Value::Null;
        assert!(twelve(&mixed).unwrap()[4].is_nan());
        mixed[4] = "0.5".into();
        assert!(twelve(&mixed).is_none());
    }
}
