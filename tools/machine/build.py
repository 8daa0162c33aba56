#!/usr/bin/env python3
"""Build the whole machine of `make machine`: a User Mode Linux kernel, and a disk with Debian and systemd as PID 1.

    tools/machine/build.py            prints the folder that has both
    tools/machine/build.py --suite trixie      the same with Debian 13
    tools/machine/build.py --usb      compiles a kernel with a USB bus (6 min): prints the folder of kernel and modules

Everything comes from Debian's packages. What was made stays in ~/.cache/dappled/machine, by the hash of its recipe,
which is this folder. It takes root.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGES = (
    "systemd,systemd-sysv,systemd-timesyncd,libpam-systemd,udev,dbus,polkitd,openssh-server,iproute2,kmod,e2fsprogs,"
    "dmsetup,gpiod,usbip,python3"
)
NETWORK = "[Match]\nName=eth0\n[Network]\nAddress=192.168.77.2/24\nLinkLocalAddressing=no\nIPv6AcceptRA=no\n"
MASKED = (
    "apt-daily.timer apt-daily-upgrade.timer e2scrub_all.timer e2scrub_reap.service fstrim.timer dpkg-db-backup.timer "
    "getty@tty1.service systemd-networkd-wait-online.service"
)
DISK_BYTES = 3 << 30
OPTIONS = "kernel.options"


def main() -> int:
    """Print the folder; exit code 1 says why there is none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--usb", action="store_true", help="a kernel with a USB bus, compiled")
    parser.add_argument("--suite", choices=("bookworm", "trixie"), default="bookworm", help="of the disk")
    parser.add_argument("--cached", action="store_true", help="only what is there")
    given = parser.parse_args()
    recipe = hashlib.sha256()
    for path in [HERE / OPTIONS] if given.usb else sorted(HERE.iterdir()):
        recipe.update(path.read_bytes() if path.is_file() and (given.usb or path.name != OPTIONS) else b"")
    if not given.usb:
        recipe.update(given.suite.encode())
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dappled" / "machine"
    made = cache / (("usb-" if given.usb else "") + recipe.hexdigest()[:16])
    needed = ["make", "flex", "bison", "bc", "gcc"] if given.usb else ["mmdebstrap", "gcc", "ip", "ssh", "mkfs.ext4"]
    missing = [name for name in needed if shutil.which(name) is None]
    if missing or os.getuid() != 0 or os.uname().machine != "x86_64" or (given.cached and not made.is_dir()):
        print(f"no machine can be built here: it takes root, x86_64, and {', '.join(needed)}", file=sys.stderr)
        return 1
    if not made.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache, prefix=".making-") as folder:
            whole = Path(folder) / "whole"
            whole.mkdir()
            if given.usb:
                usb_kernel(whole, Path(folder))
            else:
                kernel(whole, Path(folder))
                disk(whole, Path(folder), given.suite)
            whole.rename(made)
    print(made)
    return 0


def kernel(whole: Path, work: Path) -> None:
    """Debian's own kernel, and its modules."""
    packaged("user-mode-linux", work)
    shutil.move(work / "usr/bin/linux.uml", whole / "linux")
    shutil.move(work / "usr/lib/uml/modules", work / "modules")


def usb_kernel(whole: Path, work: Path) -> None:
    """A kernel with the options of `kernel.options`, and its modules."""
    packaged("linux-source-6.1", work)
    call("tar", "-xf", str(next((work / "usr/src").glob("*.tar.xz"))), "-C", str(work))
    source = next(work.glob("linux-source-*/Makefile")).parent
    build = ("nice", "-n", "10", "make", "-s", "-C", str(source), "ARCH=um")
    call(*build, "x86_64_defconfig")
    lines = (HERE / OPTIONS).read_text(encoding="utf-8").splitlines()
    wanted = [f"CONFIG_{line}" for line in lines if not line.startswith("#")]
    (source / "wanted").write_text("\n".join(wanted), encoding="utf-8")
    call("sh", "-c", f"cd {source} && scripts/kconfig/merge_config.sh -m .config wanted >/dev/null")
    call(*build, "olddefconfig")
    call(*build, f"-j{os.cpu_count()}", "linux", "modules")
    call(*build, f"INSTALL_MOD_PATH={work}/installed", "modules_install")
    shutil.move(source / "linux", whole / "linux")
    call(
        "tar",
        "-C",
        str(work / "installed"),
        "--exclude=build",
        "--exclude=source",
        "-cf",
        str(whole / "modules.tar"),
        "lib",
    )


def disk(whole: Path, work: Path, suite: str) -> None:
    """The disk of a machine that starts, has an address and lets this user in over ssh; what the kernel needs here."""
    call("gcc", "-shared", "-fPIC", "-O2", "-o", str(whole / "before_libc.so"), *map(str, HERE.glob("*.c")), "-ldl")
    call("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(whole / "key"))
    root = work / "root"
    call(
        "mmdebstrap",
        "--quiet",
        "--variant=minbase",
        f"--include={PACKAGES}",
        "--format=directory",
        suite,
        str(root),
    )
    texts = {
        "etc/systemd/network/10-host.network": NETWORK,
        "etc/fstab": "/dev/ubda / ext4 defaults,noatime 0 1\n",
        "etc/hostname": "machine\n",
        "etc/ssh/sshd_config.d/here.conf": "UseDNS no\n",
        "root/.ssh/authorized_keys": (whole / "key.pub").read_text(encoding="ascii"),
    }
    for name, text in texts.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        (root / name).write_text(text, encoding="utf-8")
    (root / "etc/systemd/network").chmod(0o755)
    shutil.copytree(work / "modules", root / "lib/modules", symlinks=True)
    call("chroot", str(root), "sh", "-c", f"systemctl -q enable systemd-networkd ssh && systemctl -q mask {MASKED}")
    with open(whole / "disk", "wb") as file:
        file.truncate(DISK_BYTES)
    call("mkfs.ext4", "-q", "-d", str(root), str(whole / "disk"))
    shutil.rmtree(root)


def packaged(name: str, work: Path) -> None:
    """Unpack a Debian package into `work`."""
    subprocess.run(["apt-get", "download", "-q", name], cwd=work, check=True, stdout=subprocess.DEVNULL)
    call("dpkg", "-x", str(next(work.glob(f"{name}_*.deb"))), str(work))


def call(*words: str) -> None:
    """Run a command that must succeed; what it prints goes to stderr."""
    subprocess.run(words, check=True, stdout=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
