//! Fetches ONNX Runtime, so that a fresh clone runs with no manual step; a build without a network still succeeds.
//!
//! The library comes out of the wheel that PyPI holds, of one pinned version and with its hash checked. Nothing here
//! fails the build: what is missing is said at run time, where it can be mended without compiling.

use std::{
    env,
    fs::{self, File},
    io::{self, Read},
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use sha2::{Digest, Sha256};

const VERSION: &str = "1.31.1";

/// A wheel of this version for one target.
struct Wheel {
    target: &'static str,
    platform: &'static str,
    sha256: &'static str,
}

const WHEELS: [Wheel; 2] = [
    Wheel {
        target: "x86_64-unknown-linux-gnu",
        platform: "manylinux_2_28_x86_64",
        sha256: "5752bd508126ae7c49894d3b9d2e83f0c3d487319246d04c444b393308d7ad7f",
    },
    Wheel {
        target: "aarch64-unknown-linux-gnu",
        platform: "manylinux_2_28_aarch64",
        sha256: "da05378364c44d4407e463982d2bf8d5e4cfea873283757e48beeb41df97b7f3",
    },
];

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=ORT_DYLIB_PATH");
    println!("cargo:rerun-if-env-changed=NIGHTFLOW_NO_FETCH");
    println!("cargo:rustc-env=NIGHTFLOW_RUNTIME_VERSION={VERSION}");
    let Some(out) = env::var_os("OUT_DIR").map(PathBuf::from) else { return };
    let library = out.join("libonnxruntime.so");
    println!("cargo:rustc-env=NIGHTFLOW_RUNTIME={}", library.display());
    // While the library is missing cargo runs this file again on every build, so a failed fetch is not kept for good.
    println!("cargo:rerun-if-changed={}", library.display());
    if ["ORT_DYLIB_PATH", "NIGHTFLOW_NO_FETCH", "DOCS_RS"].iter().any(|name| env::var_os(name).is_some()) {
        return;
    }
    if !library.exists()
        && let Err(reason) = fetch(&out, &library)
    {
        println!("cargo:warning=ONNX Runtime was not fetched, the program will say what to install: {reason}");
        return;
    }
    // OUT_DIR is <profile>/build/<crate>/out, and the executable stands in <profile>.
    if let Some(profile) = out.ancestors().nth(3) {
        let beside = profile.join("libonnxruntime.so");
        let length = |path: &Path| fs::metadata(path).map(|m| m.len()).ok();
        if length(&beside) != length(&library) {
            // A rename, for a program that runs from here may hold the old file mapped.
            let whole = profile.join("libonnxruntime.so.new");
            if let Err(error) = fs::copy(&library, &whole).and_then(|_| fs::rename(&whole, &beside)) {
                println!("cargo:warning=ONNX Runtime was not placed at {}: {error}", beside.display());
            }
        }
    }
}

/// The library out of the wheel, once its hash was found right.
fn fetch(out: &Path, library: &Path) -> Result<(), String> {
    let target = env::var("TARGET").map_err(|e| e.to_string())?;
    let wheel = WHEELS
        .iter()
        .find(|wheel| wheel.target == target)
        .ok_or_else(|| format!("no wheel is known for {target}; set ORT_DYLIB_PATH"))?;
    let file = download(out, wheel)?;
    let bytes = fs::read(&file).map_err(|e| format!("{}: {e}", file.display()))?;
    let found: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
    if found != wheel.sha256 {
        return Err(format!("{} has sha256 {found}, expected {}", file.display(), wheel.sha256));
    }
    let mut archive = zip::ZipArchive::new(io::Cursor::new(bytes)).map_err(|e| e.to_string())?;
    let member = format!("onnxruntime/capi/libonnxruntime.so.{VERSION}");
    let mut content = Vec::new();
    archive
        .by_name(&member)
        .map_err(|e| format!("{member}: {e}"))?
        .read_to_end(&mut content)
        .map_err(|e| format!("{member}: {e}"))?;
    // Under another name first: a build that is stopped half-way must not leave half a library.
    let whole = out.join("libonnxruntime.so.new");
    File::create(&whole)
        .and_then(|mut file| io::Write::write_all(&mut file, &content))
        .and_then(|()| fs::rename(&whole, library))
        .map_err(|e| format!("{}: {e}", library.display()))?;
    let _ = fs::remove_file(file);
    Ok(())
}

/// The wheel's file, by whichever pip there is.
fn download(out: &Path, wheel: &Wheel) -> Result<PathBuf, String> {
    let file = out.join(format!("onnxruntime-{VERSION}-cp311-cp311-{}.whl", wheel.platform));
    let requirement = format!("onnxruntime=={VERSION}");
    let mut tried = Vec::new();
    for pip in [&["python3", "-m", "pip"][..], &["pip3"], &["pip"]] {
        let answer = Command::new(pip[0])
            .args(&pip[1..])
            .args(["download", "-q", "--no-deps", "--only-binary=:all:", "--retries", "1"])
            .args(["--implementation", "cp", "--python-version", "3.11", "--abi", "cp311"])
            .args(["--platform", wheel.platform, "-d"])
            .arg(out)
            .arg(&requirement)
            .stdin(Stdio::null())
            .output();
        match answer {
            Ok(answer) if answer.status.success() && file.exists() => return Ok(file),
            Ok(answer) => {
                let text = String::from_utf8_lossy(&answer.stderr);
                tried.push(format!("{}: {}", pip.join(" "), text.lines().last().unwrap_or("no wheel came").trim()));
            }
            Err(error) => tried.push(format!("{}: {error}", pip.join(" "))),
        }
    }
    Err(tried.join("; "))
}
