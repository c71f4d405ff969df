//! Values and CDR bytes made by walking a definition, with nothing of the code under test but its parser.

use nightflow::wire::{
    Definitions,
    definition::{Base, Count, Field},
};
use proptest::{collection::vec, prelude::*};
use serde_json::{Map, Value, json};

/// Any value of a message; its numbers are finite, so that JSON can hold them.
pub fn any_value(all: &'static Definitions, name: &str) -> BoxedStrategy<Value> {
    let definition = all.get(name).unwrap();
    let names: Vec<String> = definition.fields.iter().map(|field| field.name.clone()).collect();
    let values: Vec<_> = definition.fields.iter().map(|field| any_field(all, field)).collect();
    values.prop_map(move |values| Value::Object(names.iter().cloned().zip(values).collect::<Map<_, _>>())).boxed()
}

fn any_field(all: &'static Definitions, field: &Field) -> BoxedStrategy<Value> {
    let one = any_base(all, &field.base);
    match field.count {
        Count::One => one,
        Count::Array(length) => vec(one, length as usize).prop_map(Value::Array).boxed(),
        Count::UpTo(most) => vec(one, 0..=most as usize).prop_map(Value::Array).boxed(),
        Count::Any => vec(one, 0..5).prop_map(Value::Array).boxed(),
    }
}

fn any_base(all: &'static Definitions, base: &Base) -> BoxedStrategy<Value> {
    macro_rules! any_number {
        ($number:ty) => {
            any::<$number>().prop_map(|value| json!(value)).boxed()
        };
    }
    match base {
        Base::Bool => any_number!(bool),
        Base::Byte | Base::Uint8 => any_number!(u8),
        Base::Int8 => any_number!(i8),
        Base::Int16 => any_number!(i16),
        Base::Uint16 => any_number!(u16),
        Base::Int32 => any_number!(i32),
        Base::Uint32 => any_number!(u32),
        Base::Int64 => any_number!(i64),
        Base::Uint64 => any_number!(u64),
        Base::Float32 => prop::num::f32::NORMAL.prop_map(|value| json!(value)).boxed(),
        Base::Float64 => prop::num::f64::NORMAL.prop_map(|value| json!(value)).boxed(),
        Base::String(_) => "\\PC{0,9}".prop_map(|text| json!(text)).boxed(),
        Base::Wstring(_) => panic!("the walk reads no wstring, and no message here has one"),
        Base::Message(name) => any_value(all, name),
    }
}

/// The CDR of a value.
pub fn write(all: &Definitions, name: &str, value: &Value, big_endian: bool) -> Vec<u8> {
    let mut writer = Writer { out: vec![0, u8::from(!big_endian), 0, 0], big_endian };
    writer.message(all, name, value);
    writer.out
}

struct Writer {
    out: Vec<u8>,
    big_endian: bool,
}

impl Writer {
    fn message(&mut self, all: &Definitions, name: &str, value: &Value) {
        for field in &all.get(name).unwrap().fields {
            let value = &value[&field.name];
            if let Count::UpTo(_) | Count::Any = field.count {
                self.number(&(value.as_array().unwrap().len() as u32).to_le_bytes());
            }
            match value {
                Value::Array(values) => values.iter().for_each(|value| self.base(all, &field.base, value)),
                value => self.base(all, &field.base, value),
            }
        }
    }

    fn base(&mut self, all: &Definitions, base: &Base, value: &Value) {
        match base {
            Base::Bool => self.out.push(u8::from(value.as_bool().unwrap())),
            Base::Byte | Base::Uint8 => self.out.push(value.as_u64().unwrap() as u8),
            Base::Int8 => self.number(&(value.as_i64().unwrap() as i8).to_le_bytes()),
            Base::Int16 => self.number(&(value.as_i64().unwrap() as i16).to_le_bytes()),
            Base::Uint16 => self.number(&(value.as_u64().unwrap() as u16).to_le_bytes()),
            Base::Int32 => self.number(&(value.as_i64().unwrap() as i32).to_le_bytes()),
            Base::Uint32 => self.number(&(value.as_u64().unwrap() as u32).to_le_bytes()),
            Base::Int64 => self.number(&value.as_i64().unwrap().to_le_bytes()),
            Base::Uint64 => self.number(&value.as_u64().unwrap().to_le_bytes()),
            Base::Float32 => self.number(&(value.as_f64().unwrap() as f32).to_le_bytes()),
            Base::Float64 => self.number(&value.as_f64().unwrap().to_le_bytes()),
            Base::String(_) => {
                let text = value.as_str().unwrap();
                self.number(&(text.len() as u32 + 1).to_le_bytes());
                self.out.extend_from_slice(text.as_bytes());
                self.out.push(0);
            }
            Base::Wstring(_) => panic!("the walk reads no wstring, and no message here has one"),
            Base::Message(name) => self.message(all, name, value),
        }
    }

    fn number(&mut self, little_endian: &[u8]) {
        while !(self.out.len() - 4).is_multiple_of(little_endian.len()) {
            self.out.push(0);
        }
        let from = self.out.len();
        self.out.extend_from_slice(little_endian);
        if self.big_endian {
            self.out[from..].reverse();
        }
    }
}

/// A struct as a value: serde's array of six rows of six is the definition's array of 36.
pub fn value_of<M: serde::Serialize>(message: &M) -> Value {
    flat(serde_json::to_value(message).unwrap())
}

fn flat(value: Value) -> Value {
    match value {
        Value::Object(fields) => Value::Object(fields.into_iter().map(|(name, value)| (name, flat(value))).collect()),
        Value::Array(values) => {
            let values = values.into_iter().map(flat);
            Value::Array(
                values
                    .flat_map(|value| match value {
                        Value::Array(inner) => inner,
                        other => vec![other],
                    })
                    .collect(),
            )
        }
        other => other,
    }
}
