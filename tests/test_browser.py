"""What the tests of pages find: a page without faults, and one with each."""

from pathlib import Path

from tests.browser import Browser

HEAD = """<!DOCTYPE html>
<style>
  body { margin: 0; background: #fff; color: #000; }
  @media (prefers-color-scheme: dark) { body { background: #000; color: #fff; } }
</style>"""


def test_faults_of_a_page(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"

    def faults(body: str) -> list[str]:
        page.write_text(HEAD + body, encoding="utf-8")
        return browser.faults(page.as_uri())

    assert faults("<p>text</p><img src='data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAA='>") == []
    assert (
        faults("<details><p class=a style='width:800px'>text</p></details>")
        == ['wider than 420 px: 800 px: <p class="a">'] * 2
    )
    assert faults("<body style='background: #888'>") == ["text or background has the same colour in the dark"]
    assert faults("<script>console.warn('one', 2)</script>") == ["console: one 2"]
    assert "console: TypeError" in faults("<script>null.x</script>")[0]
    away = faults("<img src='http://example.com/a.png'>")
    assert away[-1] == "request: http://example.com/a.png" and "ERR_NAME_NOT_RESOLVED" in away[0]
