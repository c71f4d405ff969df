//! `.msg` texts: what ROS 2 writes its message definitions in, read with every error placed in its line.

use super::Error;

/// The type of one value.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Base {
    Bool,
    /// An octet without arithmetic; a CDR byte like `Uint8`, but another type to the hash.
    Byte,
    Int8,
    /// Also what `char` means in ROS 2.
    Uint8,
    Int16,
    Uint16,
    Int32,
    Uint32,
    Int64,
    Uint64,
    Float32,
    Float64,
    /// At most so many bytes where a bound is given.
    String(Option<u32>),
    /// At most so many characters where a bound is given.
    Wstring(Option<u32>),
    /// `geometry_msgs/msg/Vector3`.
    Message(String),
}

/// How many values a field holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Count {
    /// One.
    One,
    /// Always as many, as in `float64[9]`.
    Array(u32),
    /// As many at most, as in `float64[<=9]`.
    UpTo(u32),
    /// Any number, as in `float64[]`.
    Any,
}

/// One field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// `frame_id`.
    pub name: String,
    /// The type of its values.
    pub base: Base,
    /// The number of its values.
    pub count: Count,
    /// As written, where there is one.
    pub default: Option<String>,
}

/// One constant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Constant {
    /// `INFRARED`.
    pub name: String,
    /// Its type.
    pub base: Base,
    /// As written, quotes of a string removed.
    pub value: String,
}

/// One message's definition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Definition {
    /// `sensor_msgs/msg/Range`.
    pub name: String,
    /// Constants, in their order.
    pub constants: Vec<Constant>,
    /// Fields, in their order, which is that of the bytes.
    pub fields: Vec<Field>,
}

impl Definition {
    /// Reads the text of `name`, which is in full: `sensor_msgs/msg/Range`.
    pub fn parse(name: &str, text: &str) -> Result<Self, Error> {
        let at = |line: usize, reason: String| Error::Definition { definition: name.to_owned(), line, reason };
        let package = match name.split('/').collect::<Vec<_>>()[..] {
            [package, "msg", message] if is_lower(package) && is_message(message) => package,
            _ => return Err(at(1, format!("expected a name like sensor_msgs/msg/Image, found {name:?}"))),
        };
        let mut definition = Self { name: name.to_owned(), constants: Vec::new(), fields: Vec::new() };
        for (index, line) in text.lines().enumerate() {
            let line = without_comment(line).trim();
            if !line.is_empty() {
                definition.line(package, line).map_err(|reason| at(index + 1, reason))?;
            }
        }
        Ok(definition)
    }

    /// The value of a constant, as written.
    pub fn constant(&self, name: &str) -> Option<&str> {
        self.constants.iter().find(|constant| constant.name == name).map(|constant| constant.value.as_str())
    }

    /// The messages that fields are made of, in full, in the order of the fields.
    pub fn uses(&self) -> impl Iterator<Item = &str> {
        self.fields.iter().filter_map(|field| match &field.base {
            Base::Message(name) => Some(name.as_str()),
            _ => None,
        })
    }

    fn line(&mut self, package: &str, line: &str) -> Result<(), String> {
        let (kind, rest) = line.split_once(char::is_whitespace).ok_or_else(|| format!("{line:?} has no name"))?;
        let (base, count) = kind_of(kind, package)?;
        let rest = rest.trim_start();
        let (name, rest) = rest.split_at(rest.find(|c: char| !is_word(c)).unwrap_or(rest.len()));
        let rest = rest.trim_start();
        if self.fields.iter().any(|f| f.name == name) || self.constants.iter().any(|c| c.name == name) {
            return Err(format!("{name} is there twice"));
        }
        if let Some(value) = rest.strip_prefix('=') {
            if !is_upper(name) {
                return Err(format!("expected a constant's name in capitals, found {name:?}"));
            }
            if count != Count::One {
                return Err(format!("the constant {name} can't have the type {kind}"));
            }
            let value = value_of(&base, value.trim())?;
            self.constants.push(Constant { name: name.to_owned(), base, value });
            return Ok(());
        }
        if !is_lower(name) {
            return Err(format!("expected a field's name in lower case, found {:?}", format!("{name}{rest}")));
        }
        let default = (!rest.is_empty()).then(|| rest.to_owned());
        if let Some(default) = &default {
            check_default(&base, count, default)?;
        }
        self.fields.push(Field { name: name.to_owned(), base, count, default });
        Ok(())
    }
}

fn is_word(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '_'
}

fn is_lower(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
        && !name.contains("__")
        && !name.ends_with('_')
}

fn is_upper(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_uppercase())
        && name.chars().all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_')
        && !name.contains("__")
        && !name.ends_with('_')
}

fn is_message(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_uppercase()) && name.chars().all(|c| c.is_ascii_alphanumeric())
}

/// A `#` inside quotes is text.
fn without_comment(line: &str) -> &str {
    let mut quote = None;
    let mut escaped = false;
    for (at, c) in line.char_indices() {
        match (quote, c) {
            (None, '#') => return &line[..at],
            // An apostrophe within a word opens nothing.
            (None, '"' | '\'') if line[..at].ends_with([' ', '\t', '=', '[', ',']) => quote = Some(c),
            (Some(open), c) if c == open && !escaped => quote = None,
            _ => {}
        }
        escaped = c == '\\' && !escaped;
    }
    line
}

/// `float64[<=9]`: the type of the values, and how many.
fn kind_of(kind: &str, package: &str) -> Result<(Base, Count), String> {
    let number = |text: &str| {
        text.parse::<u32>()
            .ok()
            .filter(|n| *n > 0)
            .ok_or_else(|| format!("expected a number of 1 or more in {kind:?}, found {text:?}"))
    };
    let (base, count) = match kind.strip_suffix(']') {
        None => (kind, Count::One),
        Some(open) => {
            let (base, inner) = open.rsplit_once('[').ok_or_else(|| format!("expected [ before ] in {kind:?}"))?;
            let count = match (inner, inner.strip_prefix("<=")) {
                ("", _) => Count::Any,
                (_, Some(most)) => Count::UpTo(number(most)?),
                (length, None) => Count::Array(number(length)?),
            };
            (base, count)
        }
    };
    let base = match base.split_once("<=") {
        None => base_of(base, package)?,
        Some(("string", most)) => Base::String(Some(number(most)?)),
        Some(("wstring", most)) => Base::Wstring(Some(number(most)?)),
        Some((other, _)) => return Err(format!("only string and wstring have a bound, found {other:?}")),
    };
    Ok((base, count))
}

fn base_of(base: &str, package: &str) -> Result<Base, String> {
    Ok(match base {
        "bool" => Base::Bool,
        "byte" => Base::Byte,
        "int8" => Base::Int8,
        "uint8" | "char" => Base::Uint8,
        "int16" => Base::Int16,
        "uint16" => Base::Uint16,
        "int32" => Base::Int32,
        "uint32" => Base::Uint32,
        "int64" => Base::Int64,
        "uint64" => Base::Uint64,
        "float32" => Base::Float32,
        "float64" => Base::Float64,
        "string" => Base::String(None),
        "wstring" => Base::Wstring(None),
        _ => Base::Message(match base.split('/').collect::<Vec<_>>()[..] {
            [message] if is_message(message) => format!("{package}/msg/{message}"),
            [package, message] | [package, "msg", message] if is_lower(package) && is_message(message) => {
                format!("{package}/msg/{message}")
            }
            _ => return Err(format!("expected a type, found {base:?}")),
        }),
    })
}

fn check_default(base: &Base, count: Count, text: &str) -> Result<(), String> {
    if count == Count::One {
        return value_of(base, text).map(drop);
    }
    let inner = text.strip_prefix('[').and_then(|rest| rest.strip_suffix(']'));
    let inner = inner.ok_or_else(|| format!("expected values between [ and ], found {text:?}"))?;
    let values = elements(inner);
    match count {
        Count::Array(n) if values.len() != n as usize => Err(format!("expected {n} values, found {}", values.len())),
        Count::UpTo(n) if values.len() > n as usize => {
            Err(format!("expected at most {n} values, found {}", values.len()))
        }
        _ => values.into_iter().try_for_each(|value| value_of(base, value).map(drop)),
    }
}

/// Splits at commas that stand outside of quotes.
fn elements(text: &str) -> Vec<&str> {
    let mut quote = None;
    let parts = text.split(|c| match (quote, c) {
        (None, ',') => true,
        (None, '"' | '\'') => {
            quote = Some(c);
            false
        }
        (Some(open), c) => {
            if c == open {
                quote = None;
            }
            false
        }
        _ => false,
    });
    let parts: Vec<&str> = parts.map(str::trim).collect();
    if parts == [""] { Vec::new() } else { parts }
}

/// A value of the type, or what is wrong with it.
fn value_of(base: &Base, text: &str) -> Result<String, String> {
    fn is<T: std::str::FromStr>(text: &str) -> bool {
        text.parse::<T>().is_ok()
    }
    let fits = match base {
        Base::Bool => matches!(text.to_ascii_lowercase().as_str(), "true" | "false" | "0" | "1"),
        Base::Byte | Base::Uint8 => is::<u8>(text),
        Base::Int8 => is::<i8>(text),
        Base::Int16 => is::<i16>(text),
        Base::Uint16 => is::<u16>(text),
        Base::Int32 => is::<i32>(text),
        Base::Uint32 => is::<u32>(text),
        Base::Int64 => is::<i64>(text),
        Base::Uint64 => is::<u64>(text),
        Base::Float32 | Base::Float64 => is::<f64>(text),
        Base::String(bound) | Base::Wstring(bound) => return string_of(*bound, text),
        Base::Message(name) => return Err(format!("{name} can't have the value {text:?}")),
    };
    if fits { Ok(text.to_owned()) } else { Err(format!("expected a {base:?}, found {text:?}")) }
}

fn string_of(bound: Option<u32>, text: &str) -> Result<String, String> {
    let inner = match text.chars().next() {
        Some(quote @ ('"' | '\'')) => {
            let inner = text.strip_prefix(quote).and_then(|rest| rest.strip_suffix(quote));
            inner.ok_or_else(|| format!("expected {quote} at the end of {text:?}"))?
        }
        _ => text,
    };
    match bound {
        Some(most) if inner.chars().count() > most as usize => {
            Err(format!("expected at most {most} characters, found {}", inner.chars().count()))
        }
        _ => Ok(inner.to_owned()),
    }
}
