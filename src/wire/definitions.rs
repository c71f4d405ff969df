//! Definitions that know each other: what a recording's schema and a type's hash are made of.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write,
};

use sha2::{Digest, Sha256};

use super::{
    Error,
    definition::{Base, Count, Definition, Field},
};

/// Definitions by their full names, with their texts.
#[derive(Debug, Clone, Default)]
pub struct Definitions {
    all: BTreeMap<String, (Definition, String)>,
}

impl Definitions {
    /// Takes in the text of `name` (`sensor_msgs/msg/Image`), in place of an older one.
    pub fn insert(&mut self, name: &str, text: &str) -> Result<(), Error> {
        let definition = Definition::parse(name, text)?;
        self.all.insert(name.to_owned(), (definition, text.to_owned()));
        Ok(())
    }

    /// Takes in a `ros2msg` schema: the text of `name`, and after it those that it depends on.
    pub fn insert_schema(&mut self, name: &str, schema: &str) -> Result<(), Error> {
        let mut name = name.to_owned();
        let mut text = String::new();
        let mut lines = schema.lines().enumerate();
        while let Some((index, line)) = lines.next() {
            if !is_ruler(line) {
                text.push_str(line);
                text.push('\n');
                continue;
            }
            let next =
                lines.next().and_then(|(_, line)| line.strip_prefix("MSG: ")).and_then(|next| full_name(next.trim()));
            let next = next.ok_or_else(|| Error::Definition {
                definition: name.clone(),
                line: index + 2,
                reason: "expected MSG: and a name after the line of =".to_owned(),
            })?;
            self.insert(&std::mem::replace(&mut name, next), &std::mem::take(&mut text))?;
        }
        self.insert(&name, &text)
    }

    /// The definition of `sensor_msgs/msg/Image`.
    pub fn get(&self, name: &str) -> Option<&Definition> {
        self.all.get(name).map(|(definition, _)| definition)
    }

    /// The text of `sensor_msgs/msg/Image`, alone.
    pub fn text(&self, name: &str) -> Option<&str> {
        self.all.get(name).map(|(_, text)| text.as_str())
    }

    /// Every name, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.all.keys().map(String::as_str)
    }

    /// The `ros2msg` schema that rosbag2 writes and Foxglove reads: the text, and below it every text that it needs.
    pub fn schema(&self, name: &str) -> Result<String, Error> {
        let mut schema = String::new();
        for needed in self.needed(name)? {
            if !schema.is_empty() {
                let short = needed.replacen("/msg/", "/", 1);
                schema.push_str(&format!("{}\nMSG: {short}\n", "=".repeat(80)));
            }
            schema.push_str(self.text(needed).unwrap_or_default());
            if !schema.ends_with('\n') {
                schema.push('\n');
            }
        }
        Ok(schema)
    }

    /// `RIHS01_` and the SHA-256 of the type description as JSON, as REP 2016 and rosidl's generator have it.
    pub fn type_hash(&self, name: &str) -> Result<String, Error> {
        let mut json = String::from("{\"type_description\": ");
        describe(self.find(name, name)?, &mut json);
        json.push_str(", \"referenced_type_descriptions\": [");
        let references: BTreeSet<&str> = self.needed(name)?.into_iter().skip(1).collect();
        for (index, reference) in references.into_iter().enumerate() {
            json.push_str(if index == 0 { "" } else { ", " });
            describe(self.find(reference, name)?, &mut json);
        }
        json.push_str("]}");
        let mut hash = String::from("RIHS01_");
        for byte in Sha256::digest(json) {
            push(&mut hash, format_args!("{byte:02x}"));
        }
        Ok(hash)
    }

    fn find(&self, name: &str, user: &str) -> Result<&Definition, Error> {
        self.get(name).ok_or_else(|| Error::Definition {
            definition: user.to_owned(),
            line: 1,
            reason: format!("the definition of {name} is needed, and is not here"),
        })
    }

    /// `name` first, then each one that it is made of, where it is first met.
    fn needed(&self, name: &str) -> Result<Vec<&str>, Error> {
        let mut needed = Vec::new();
        let mut ahead = vec![self.find(name, name)?];
        while let Some(definition) = ahead.pop() {
            if needed.contains(&definition.name.as_str()) {
                continue;
            }
            needed.push(definition.name.as_str());
            let uses: Vec<&str> = definition.uses().collect();
            for used in uses.into_iter().rev() {
                ahead.push(self.find(used, &definition.name)?);
            }
        }
        Ok(needed)
    }
}

fn is_ruler(line: &str) -> bool {
    line.len() == 80 && line.bytes().all(|byte| byte == b'=')
}

/// `pkg/Type` and `pkg/msg/Type` are both in use.
fn full_name(name: &str) -> Option<String> {
    match name.split('/').collect::<Vec<_>>()[..] {
        [package, message] | [package, "msg", message] => Some(format!("{package}/msg/{message}")),
        _ => None,
    }
}

fn push(text: &mut String, what: std::fmt::Arguments<'_>) {
    // Writing into a String can't fail.
    let _ = text.write_fmt(what);
}

/// Names hold nothing that JSON would escape: the parser saw to that.
fn describe(definition: &Definition, json: &mut String) {
    push(json, format_args!("{{\"type_name\": \"{}\", \"fields\": [", definition.name));
    // The generators put this into an empty message, as C has no empty struct.
    let filler = Field {
        name: "structure_needs_at_least_one_member".to_owned(),
        base: Base::Uint8,
        count: Count::One,
        default: None,
    };
    let fields = if definition.fields.is_empty() { std::slice::from_ref(&filler) } else { &definition.fields };
    for (index, field) in fields.iter().enumerate() {
        json.push_str(if index == 0 { "" } else { ", " });
        let nested = if let Base::Message(name) = &field.base { name.as_str() } else { "" };
        let (type_id, capacity, string_capacity) = type_of(field);
        push(
            json,
            format_args!(
                "{{\"name\": \"{}\", \"type\": {{\"type_id\": {type_id}, \"capacity\": {capacity}, \
                 \"string_capacity\": {string_capacity}, \"nested_type_name\": \"{nested}\"}}}}",
                field.name
            ),
        );
    }
    json.push_str("]}");
}

/// The numbers of `type_description_interfaces/msg/FieldType`.
fn type_of(field: &Field) -> (u32, u32, u32) {
    let (base, string_capacity) = match field.base {
        Base::Message(_) => (1, 0),
        Base::Int8 => (2, 0),
        Base::Uint8 => (3, 0),
        Base::Int16 => (4, 0),
        Base::Uint16 => (5, 0),
        Base::Int32 => (6, 0),
        Base::Uint32 => (7, 0),
        Base::Int64 => (8, 0),
        Base::Uint64 => (9, 0),
        Base::Float32 => (10, 0),
        Base::Float64 => (11, 0),
        Base::Bool => (15, 0),
        Base::Byte => (16, 0),
        Base::String(None) => (17, 0),
        Base::Wstring(None) => (18, 0),
        Base::String(Some(most)) => (21, most),
        Base::Wstring(Some(most)) => (22, most),
    };
    let (shift, capacity) = match field.count {
        Count::One => (0, 0),
        Count::Array(length) => (48, length),
        Count::UpTo(most) => (96, most),
        Count::Any => (144, 0),
    };
    (base + shift, capacity, string_capacity)
}
