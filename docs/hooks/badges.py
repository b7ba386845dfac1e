"""Show under the title of each page on what its content was tested, from the key ``tested`` at the head of the page."""

from typing import Any

WORDS = {"simulation": "in simulation", "firmware": "on firmware", "vehicle": "on a vehicle"}


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Add the badges below the first heading.

    Raises:
        ValueError: The key names something else.
    """
    tested = page.meta.get("tested")
    if tested is None:
        return markdown
    if unknown := set(tested) - set(WORDS):
        raise ValueError(f"{page.file.src_path}: tested must name {list(WORDS)}, got {sorted(unknown)}")
    badges = " ".join(
        f'<span class="badge {"tested" if name in tested else "untested"}">'
        f"{'tested' if name in tested else 'not tested'} {words}</span>"
        for name, words in WORDS.items()
    )
    title, _, rest = markdown.partition("\n")
    return f"{title}\n\n{badges}\n{rest}"
