"""No file of the product calls what only some systems have, but for those whose tests stand in for the others."""

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
TESTED = {
    f"warpgs/{name}.py"
    for name in (
        "files", "device", "process", "kernels/launch", "locks", "ranks", "folders",
    )
}  # fmt: skip
FILES = [p for p in sorted((ROOT / "warpgs").rglob("*.py")) if p.relative_to(ROOT).as_posix() not in TESTED]
MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "msvcrt", "winreg"}
NAMES = {
    "os": {"sysconf", "fork", "getuid", "geteuid", "getgid", "getpgid", "setsid", "uname", "getloadavg", "killpg", "statvfs",
           "sched_getaffinity", "sched_setaffinity", "mkfifo", "chown", "nice", "sendfile", "startfile"},
    "signal": {"SIGKILL", "SIGALRM", "SIGHUP", "SIGUSR1", "SIGUSR2", "setitimer", "alarm", "pause"},
}  # fmt: skip
FOLDERS = ("/proc/", "/sys/", "/dev/", "/etc/", "/tmp/")


def found_in(path: Path) -> list[str]:
    """Return what a file calls, imports or names that only some systems have."""
    found = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name in MODULES]
        elif isinstance(node, ast.ImportFrom):
            found += [node.module] * (node.module in MODULES)
            found += [a.name for a in node.names if a.name in NAMES.get(node.module, ())]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            found += [ast.unparse(node)] * (node.attr in NAMES.get(node.value.id, ()))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found += [node.value] * node.value.startswith(FOLDERS)
    return found


def test_every_system_has_what_is_called():
    assert not {p.relative_to(ROOT).as_posix(): names for p in FILES if (names := found_in(p))}
