"""Every message that docs/troubleshooting.md quotes is one that the code can print."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent


def messages() -> list[str]:
    """Return all string literals of the package, with ... where a value is filled in."""
    found = []
    for path in sorted((ROOT / "warpgs").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.JoinedStr):
                found.append("".join(p.value if isinstance(p, ast.Constant) else "..." for p in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def test_quoted_messages_are_there():
    quoted = re.findall(r"^\*\*`(.+)`\*\*", (ROOT / "docs/troubleshooting.md").read_text("utf-8"), re.MULTILINE)
    assert len(quoted) > 30
    known, missing = messages(), []
    for message in quoted:
        pattern = re.compile(".*?".join(re.escape(p.strip()) for p in message.split("...") if p.strip()), re.DOTALL)
        if not any(map(pattern.search, known)):
            missing.append(message)
    assert not missing, f"docs/troubleshooting.md quotes what nothing says: {missing}"
