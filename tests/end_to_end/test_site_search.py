"""The search of the documentation, opened as a file as README shows it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from ruamel.yaml import YAML

ROOT = Path(__file__).parents[2]


def test_the_search_of_the_site_works_without_a_server(tmp_path, browser):
    yaml = YAML()
    settings = yaml.load(ROOT / "mkdocs.yml")
    # Two pages of it, without the interface: that imports and renders the program.
    for key in ("hooks", "nav", "validation"):
        del settings[key]
    settings["plugins"] = [plugin for plugin in settings["plugins"] if "mkdocstrings" not in plugin]
    yaml.dump(settings, tmp_path / "mkdocs.yml")
    shutil.copytree(ROOT / "docs/javascripts", tmp_path / "docs/javascripts")
    shutil.copytree(ROOT / "docs/stylesheets", tmp_path / "docs/stylesheets")
    (tmp_path / "docs" / "index.md").write_text("# Home\n\nNothing of the kind.\n")
    (tmp_path / "docs" / "light.md").write_text("# Light\n\nThe guard shuts the light.\n")
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    subprocess.run([sys.executable, "-m", "mkdocs", "build", "--quiet"], cwd=tmp_path, env=environment, check=True)
    page = browser.new_page()
    page.goto((tmp_path / "build/site/index.html").as_uri())
    page.locator(".md-search__input").click()
    page.keyboard.type("guard")
    hit = page.locator(".md-search-result__link").first
    hit.wait_for()
    address = hit.get_attribute("href")
    assert "light.html" in str(address)
