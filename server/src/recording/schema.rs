//! Schemas of the messages: the descriptors of a message type and of what it refers to, without comments.

use std::collections::{BTreeMap, BTreeSet};

use nesam_proto::v1::FILE_DESCRIPTOR_SET;
use prost::Message as _;
use prost_types::field_descriptor_proto::Type;
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet};

/// All descriptors of the interface.
#[derive(Debug)]
pub(crate) struct Descriptors {
    files: Vec<FileDescriptorProto>,
    /// Message types by full name, for instance `nesam.v1.Session`.
    messages: BTreeMap<String, DescriptorProto>,
}

impl Descriptors {
    /// Those of this program.
    pub fn of_program() -> Self {
        let set = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).expect("the committed descriptor set decodes; this is a bug");
        let files: Vec<_> = set.file.into_iter().map(|file| FileDescriptorProto { source_code_info: None, ..file }).collect();
        let mut messages = BTreeMap::new();
        for file in &files {
            let types = file.message_type.iter();
            messages.extend(types.map(|message| (format!("{}.{}", file.package(), message.name()), message.clone())));
        }
        Self { files, messages }
    }

    /// The encoded `FileDescriptorSet` that a reader needs for one message type.
    pub fn schema_of(&self, message: &str) -> Vec<u8> {
        let holds = |file: &&FileDescriptorProto| {
            file.message_type.iter().any(|m| message.strip_prefix(file.package()).and_then(|rest| rest.strip_prefix('.')) == Some(m.name()))
        };
        let mut needed: BTreeSet<&str> = self.files.iter().find(holds).map(FileDescriptorProto::name).into_iter().collect();
        let mut open: Vec<&str> = needed.iter().copied().collect();
        while let Some(name) = open.pop() {
            for imported in self.files.iter().filter(|file| file.name() == name).flat_map(|file| &file.dependency) {
                if needed.insert(imported) {
                    open.push(imported);
                }
            }
        }
        let file = self.files.iter().filter(|file| needed.contains(file.name())).cloned().collect();
        FileDescriptorSet { file }.encode_to_vec()
    }

    /// A field of a message type.
    pub fn field(&self, message: &str, number: u32) -> Option<&FieldDescriptorProto> {
        self.messages.get(message)?.field.iter().find(|field| u32::try_from(field.number()) == Ok(number))
    }
}

/// Full name of the message type of a field, without the leading dot; `None` for a field that is no message.
pub(crate) fn message_of(field: &FieldDescriptorProto) -> Option<&str> {
    (field.r#type() == Type::Message).then(|| field.type_name().trim_start_matches('.'))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::Topic;

    #[test]
    fn property_every_topic_has_a_schema_that_is_closed() {
        let descriptors = Descriptors::of_program();
        for topic in Topic::ALL {
            let set = FileDescriptorSet::decode(descriptors.schema_of(topic.message()).as_slice()).unwrap();
            let defined =
                |name: &str| set.file.iter().any(|f| f.message_type.iter().any(|m| format!("{}.{}", f.package(), m.name()) == name));
            assert!(defined(topic.message()), "{}", topic.message());
            for file in &set.file {
                assert!(file.dependency.iter().all(|d| set.file.iter().any(|f| f.name() == d)), "{}: {}", topic.message(), file.name());
                for field in file.message_type.iter().flat_map(|m| &m.field) {
                    assert!(message_of(field).is_none_or(defined), "{}.{}", file.name(), field.name());
                }
            }
            assert_eq!(Topic::of_name(topic.name()), Some(*topic));
        }
    }
}
