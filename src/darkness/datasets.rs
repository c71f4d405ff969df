//! Data sets with true flow, told apart by how their folders are laid out.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs, io,
    path::{Path, PathBuf},
};

use super::{
    flow_files::{self, Field},
    photographs,
    picture::Picture,
    raws,
};

/// Ways in which data sets are laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// `CCPPQQEE_img1.*`, `_img2.*`, `_flow.flo`: camera, position before and after, exposure (VBOF).
    Vbof,
    /// `NAME_img1.*`, `NAME_img2.*`, `NAME_flow.flo` (FlyingChairs, FCDN, and whoever names files so).
    Pairs,
    /// `other-data/NAME/frame10.png`, `frame11.png` and `other-gt-flow/NAME/flow10.flo`, or all three in `NAME/`.
    Middlebury,
    /// `clean/SCENE/frame_0001.png`, `final/…` and `flow/SCENE/frame_0001.flo`.
    Sintel,
    /// `image_2/000000_10.png`, `_11.png`, `flow_occ/000000_10.png`, `flow_noc/…`; 2012 has `colored_0` or `image_0`.
    Kitti,
}

/// All kinds with their names.
pub const KINDS: [(&str, Kind); 5] = [
    ("vbof", Kind::Vbof),
    ("pairs", Kind::Pairs),
    ("middlebury", Kind::Middlebury),
    ("sintel", Kind::Sintel),
    ("kitti", Kind::Kitti),
];

/// One pair of a data set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Item {
    /// Unique in the set, fit for a file's name.
    pub name: String,
    /// What the tables sort it under: an exposure, a pass, or `all`.
    pub condition: String,
    /// The two frames' files.
    pub frames: [PathBuf; 2],
    /// Files of the truth, each with what the tables sort it under; KITTI has two of them. None where a pair was looked
    /// for that need not have one.
    pub truths: Vec<(String, PathBuf)>,
}

/// Something that could not be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Skipped {
    /// The pair, or the file.
    pub what: String,
    /// Why.
    pub why: String,
}

/// What could not be used, as Markdown; nothing where there is nothing.
pub fn left_out(skipped: &[Skipped]) -> String {
    if skipped.is_empty() {
        return String::new();
    }
    let lines: String = skipped.iter().map(|Skipped { what, why }| format!("- {what}: {why}\n")).collect();
    format!("\n### Left out: {}\n\n{lines}", skipped.len())
}

/// What was found in a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// Its layout.
    pub kind: Kind,
    /// Whole pairs, sorted by name.
    pub items: Vec<Item>,
    /// Pairs that lack a file.
    pub skipped: Vec<Skipped>,
}

/// Why there is no data set.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The folder can't be read.
    #[error("{}", path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Nothing that is known.
    #[error(
        "{}: expected CCPPQQEE_img1.* (VBOF), NAME_img1.* with NAME_img2.* and NAME_flow.flo (FlyingChairs, FCDN), \
         other-data/ and other-gt-flow/ (Middlebury), clean/ or final/ and flow/ (Sintel), or image_2/ and flow_occ/ \
         (KITTI), found {found}", path.display()
    )]
    Unknown {
        /// The folder.
        path: PathBuf,
        /// Some of what is in it.
        found: String,
    },
    /// Pairs that are told by their flow files can't be found without them.
    #[error(
        "{}: expected pairs that are known without their flow, CCPPQQEE_img1.* with CCPPQQEE_img2.* (vbof) or NAME_img1.* \
         with NAME_img2.* (pairs), found the layout of {found}", path.display()
    )]
    Labelled {
        /// The folder.
        path: PathBuf,
        /// The layout's name.
        found: &'static str,
    },
}

/// A pair in memory.
#[derive(Debug, Clone, PartialEq)]
pub struct Loaded {
    /// Both frames, of one size.
    pub frames: [Picture; 2],
    /// The truth, of the same size, and what the tables sort it under.
    pub truths: Vec<(String, Field)>,
}

/// Names in a folder, sorted; none where there is no such folder.
fn names(folder: &Path) -> Vec<String> {
    let Ok(entries) = fs::read_dir(folder) else { return vec![] };
    let mut names: Vec<String> =
        entries.filter_map(|entry| Some(entry.ok()?.file_name().to_string_lossy().into_owned())).collect();
    names.sort();
    names
}

/// Looks at a folder; `kind` overrides what its layout says.
pub fn find(folder: &Path, kind: Option<Kind>) -> Result<Found, Error> {
    look(folder, kind, true)
}

/// Looks at a folder of pairs that need no truth: VBOF's layout or FlyingChairs'. A truth that is there is found too.
pub fn find_unlabelled(folder: &Path, kind: Option<Kind>) -> Result<Found, Error> {
    look(folder, kind, false)
}

fn look(folder: &Path, kind: Option<Kind>, labelled: bool) -> Result<Found, Error> {
    let top = fs::read_dir(folder).map_err(|source| Error::Io { path: folder.into(), source })?;
    drop(top);
    // The sets' archives unpack into these.
    let roots = ["", "training", "data"].map(|inner| folder.join(inner));
    let detected = roots.iter().find_map(|root| Some((root, kind_of(root)?)));
    let (root, kind) = match (kind, detected) {
        (Some(kind), Some((root, _))) => (root.as_path(), kind),
        (Some(kind), None) => (folder, kind),
        (None, Some((root, kind))) => (root.as_path(), kind),
        (None, None) => {
            let names = names(folder);
            let more = if names.len() > 8 { ", …" } else { "" };
            let found = if names.is_empty() { "nothing".into() } else { names[..names.len().min(8)].join(", ") + more };
            return Err(Error::Unknown { path: folder.into(), found });
        }
    };
    let (mut items, skipped) = match kind {
        Kind::Vbof | Kind::Pairs => pairs(root, kind, labelled),
        _ if !labelled => {
            let found = KINDS.iter().find(|(_, known)| *known == kind).map_or("", |(name, _)| name);
            return Err(Error::Labelled { path: folder.into(), found });
        }
        Kind::Middlebury => whole(middlebury(root)),
        Kind::Sintel => whole(sintel(root)),
        Kind::Kitti => whole(kitti(root)),
    };
    items.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(Found { kind, items, skipped })
}

fn kind_of(root: &Path) -> Option<Kind> {
    let has = |inner: &str| root.join(inner).is_dir();
    if has("flow_occ") && camera_folder(root).is_some() {
        return Some(Kind::Kitti);
    }
    if has("flow") && (has("clean") || has("final")) {
        return Some(Kind::Sintel);
    }
    let inside = names(root);
    if has("other-gt-flow") || inside.iter().any(|name| root.join(name).join("flow10.flo").exists()) {
        return Some(Kind::Middlebury);
    }
    let stems: BTreeSet<&str> = inside.iter().filter_map(|name| Some(part_of(name)?.0)).collect();
    let eight = |stem: &&str| stem.len() == 8 && stem.bytes().all(|letter| letter.is_ascii_digit());
    (!stems.is_empty()).then(|| if stems.iter().all(eight) { Kind::Vbof } else { Kind::Pairs })
}

/// Stem and role of `STEM_img1.png`, `STEM_img2.png` and `STEM_flow.flo`.
fn part_of(name: &str) -> Option<(&str, usize)> {
    let (base, ending) = name.rsplit_once('.')?;
    let roles = [("_img1", 0), ("_img2", 1), ("_flow", 2)];
    let (stem, role) = roles.into_iter().find_map(|(part, role)| Some((base.strip_suffix(part)?, role)))?;
    let fits = match role {
        2 => ["flo", "png"].contains(&ending),
        _ => {
            photographs::is_raw(name) || ["png", "ppm", "pgm", "jpg", "jpeg"].contains(&ending.to_lowercase().as_str())
        }
    };
    (fits && !stem.is_empty()).then_some((stem, role))
}

fn pairs(root: &Path, kind: Kind, labelled: bool) -> (Vec<Item>, Vec<Skipped>) {
    let mut parts: BTreeMap<String, [Option<PathBuf>; 3]> = BTreeMap::new();
    for name in names(root) {
        if let Some((stem, role)) = part_of(&name) {
            let place = &mut parts.entry(stem.into()).or_default()[role];
            // Where a raw lies beside its developed picture, the picture is the published one.
            if place.is_none() || !photographs::is_raw(&name) {
                *place = Some(root.join(&name));
            }
        }
    }
    let flows: Vec<(String, PathBuf)> =
        parts.iter().filter_map(|(stem, part)| Some((stem.clone(), part[2].clone()?))).collect();
    let (mut items, mut skipped) = (vec![], vec![]);
    for (name, [first, second, flow]) in parts {
        // The camera stood still between exposures, so that a pair without a flow of its own has that of its brightest.
        let same = |other: &&(String, PathBuf)| kind == Kind::Vbof && other.0.get(..6) == name.get(..6);
        let flow = flow.or_else(|| flows.iter().find(same).map(|(_, path)| path.clone()));
        let condition = match kind {
            Kind::Vbof => format!("exposure {}", name.get(6..8).unwrap_or("?").trim_start_matches('0')),
            _ => "all".into(),
        };
        match (first, second, flow) {
            (Some(first), Some(second), flow) if flow.is_some() || !labelled => {
                let truths = flow.map(|flow| (condition.clone(), flow)).into_iter().collect();
                items.push(Item { truths, name, condition, frames: [first, second] })
            }
            (None, None, Some(_)) if kind == Kind::Vbof || !labelled => {}
            (first, second, flow) => {
                let flowless = labelled && flow.is_none();
                let lacks = [(first.is_none(), "_img1.*"), (second.is_none(), "_img2.*"), (flowless, "_flow.flo")];
                let lacks: Vec<String> =
                    lacks.iter().filter(|(lacks, _)| *lacks).map(|(_, part)| format!("{name}{part}")).collect();
                skipped.push(Skipped { why: format!("there is no {}", lacks.join(", no ")), what: name });
            }
        }
    }
    (items, skipped)
}

/// Sorts out pairs whose files aren't all there.
fn whole(items: Vec<Item>) -> (Vec<Item>, Vec<Skipped>) {
    let lacking = |item: &Item| -> Vec<String> {
        let files = item.frames.iter().chain(item.truths.iter().map(|(_, path)| path));
        files.filter(|path| !path.exists()).map(|path| path.display().to_string()).collect()
    };
    let (mut kept, mut skipped) = (vec![], vec![]);
    for item in items {
        match lacking(&item) {
            lacks if lacks.is_empty() => kept.push(item),
            lacks => skipped.push(Skipped { what: item.name, why: format!("there is no {}", lacks.join(", no ")) }),
        }
    }
    (kept, skipped)
}

fn middlebury(root: &Path) -> Vec<Item> {
    let apart = root.join("other-gt-flow").is_dir();
    let (pictures, flows) = if apart { ("other-data", "other-gt-flow") } else { ("", "") };
    let scene = |name: String| {
        let (from, to) = (root.join(pictures).join(&name), root.join(flows).join(&name));
        let condition = String::from("all");
        Item {
            frames: [from.join("frame10.png"), from.join("frame11.png")],
            truths: vec![(condition.clone(), to.join("flow10.flo"))],
            name,
            condition,
        }
    };
    // `other-data` has scenes without a published truth, which are none of ours.
    names(&root.join(flows)).into_iter().filter(|name| root.join(flows).join(name).is_dir()).map(scene).collect()
}

fn sintel(root: &Path) -> Vec<Item> {
    let mut items = vec![];
    for pass in ["clean", "final"].into_iter().filter(|pass| root.join(pass).is_dir()) {
        for scene in names(&root.join("flow")) {
            for flow in names(&root.join("flow").join(&scene)) {
                let Some((number, digits)) = flow
                    .strip_suffix(".flo")
                    .and_then(|base| base.strip_prefix("frame_"))
                    .and_then(|digits| Some((digits.parse::<u32>().ok()?, digits.len())))
                else {
                    continue;
                };
                let frame = |number: u32| root.join(pass).join(&scene).join(format!("frame_{number:0digits$}.png"));
                items.push(Item {
                    name: format!("{pass}_{scene}_{number:0digits$}"),
                    condition: pass.into(),
                    frames: [frame(number), frame(number + 1)],
                    truths: vec![(pass.into(), root.join("flow").join(&scene).join(&flow))],
                });
            }
        }
    }
    items
}

/// The left camera's pictures: colour, and grey where there is no colour.
fn camera_folder(root: &Path) -> Option<PathBuf> {
    ["image_2", "colored_0", "image_0"].into_iter().map(|name| root.join(name)).find(|path| path.is_dir())
}

fn kitti(root: &Path) -> Vec<Item> {
    let pictures = camera_folder(root).unwrap_or_else(|| root.join("image_2"));
    let mut items = vec![];
    for file in names(&root.join("flow_occ")) {
        let Some(name) = file.strip_suffix("_10.png") else { continue };
        // `occ` has every pixel, `noc` only those that stay in sight.
        let mut truths = vec![("occ".to_string(), root.join("flow_occ").join(&file))];
        if root.join("flow_noc").is_dir() {
            truths.push(("noc".into(), root.join("flow_noc").join(&file)));
        }
        items.push(Item {
            name: name.into(),
            condition: "all".into(),
            frames: ["10", "11"].map(|time| pictures.join(format!("{name}_{time}.png"))),
            truths,
        });
    }
    items
}

/// Reads a pair; what doesn't fit is named. Raws are reduced to the truth's size, or as [`raws::pair`] says without one.
pub fn load(item: &Item) -> Result<Loaded, Skipped> {
    let skip = |why: String| Skipped { what: item.name.clone(), why };
    let mut truths = Vec::with_capacity(item.truths.len());
    for (condition, path) in &item.truths {
        truths.push((condition.clone(), flow_files::read(path).map_err(|error| skip(said(&error)))?));
    }
    let size = truths.first().map(|(_, truth)| (truth.width, truth.height));
    let frames = if item.frames.iter().any(|path| photographs::is_raw(&path.to_string_lossy())) {
        raws::pair(item.frames.each_ref().map(PathBuf::as_path), size).map_err(|error| skip(said(&error)))?
    } else {
        let read = |path: &PathBuf| flow_files::read_frame(path).map(Picture::from).map_err(|error| skip(said(&error)));
        [read(&item.frames[0])?, read(&item.frames[1])?]
    };
    let against = if size.is_some() { "truth" } else { "older frame" };
    let size = size.unwrap_or((frames[0].width, frames[0].height));
    for (what, (width, height)) in frames
        .iter()
        .zip(&item.frames)
        .map(|(frame, path)| (path.display().to_string(), (frame.width, frame.height)))
        .chain(
            truths
                .iter()
                .zip(&item.truths)
                .map(|((_, truth), (_, path))| (path.display().to_string(), (truth.width, truth.height))),
        )
    {
        if (width, height) != size {
            return Err(skip(format!("{what} is {width}×{height}, its {against} is {}×{}", size.0, size.1)));
        }
    }
    Ok(Loaded { frames, truths })
}

/// An error with its causes, in a line.
pub fn said(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(inner) = cause {
        text += &format!(": {inner}");
        cause = inner.source();
    }
    text
}
