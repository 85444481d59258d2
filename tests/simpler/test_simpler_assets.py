"""Fetching SIMPLER's assets: files are verified, downloads resume, and nothing is written outside the folder."""

from __future__ import annotations

import fcntl
import hashlib
import io
import json
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

import httpx
import pytest
from support.asset_server import CAN, FILES, Server, write
from support.simpler_files import ARCHIVE
from typer.testing import CliRunner

from vecenv.simpler.assets import archives, pull
from vecenv.simpler.assets import files as assets
from vecenv.simpler.assets.download import RetryPolicy, check_redirect
from vecenv.simpler.assets.errors import FileNotInSource
from vecenv.simpler.assets.files import Entry, Manifest, ManifestError, read_manifest, resolve
from vecenv.simpler.assets.pull import Archive, PullError, Report
from vecenv.simpler.cli import assets_app

QUICK = RetryPolicy(attempts=3, connect=1.0, read=0.3, wait=0.0)
ONCE = RetryPolicy(attempts=1, connect=1.0, read=0.3, wait=0.0)


def entry(path: str, content: bytes) -> Entry:
    return Entry(path=PurePosixPath(path), size=len(content), sha256=hashlib.sha256(content).hexdigest())


def listed(files: dict[str, bytes]) -> Manifest:
    return Manifest(commit="c0ffee", files=tuple(entry(path, content) for path, content in files.items()))


def held(folder: Path) -> dict[str, bytes]:
    """What lies in a folder, downloads that were begun left out."""
    files = {file.relative_to(folder): file for file in folder.rglob("*") if file.is_file()}
    return {path.as_posix(): file.read_bytes() for path, file in files.items() if path.parts[0] != ".partial"}


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as made:
        made.files = dict(FILES)
        thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield made
        made.over.set()
        made.shutdown()
        thread.join()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "tree"


def pulled(root: Path, server: Server, retry: RetryPolicy = QUICK, files: dict[str, bytes] | None = None) -> Report:
    return pull.pull(root, server.url, manifest=listed(files or FILES), retry=retry)


# From a server


def test_all_files_arrive_and_are_not_asked_for_again(server: Server, root: Path) -> None:
    first = pulled(root, server)
    assert (held(root), len(first.fetched), first.complete) == (FILES, 3, True)
    assert not (root / ".partial").exists()
    server.asked.clear()
    again = pulled(root, server)
    assert (len(again.kept), again.fetched, server.asked) == (3, (), [])


def test_a_damaged_file_is_replaced(server: Server, root: Path) -> None:
    pulled(root, server)
    (root / CAN).write_bytes(FILES[CAN].replace(b"0", b"1", 1))
    assert pulled(root, server).fetched == (PurePosixPath(CAN),)
    assert held(root) == FILES


@pytest.mark.parametrize("trick", ["truncate", "stall", "too short"])
def test_a_transfer_that_breaks_off_is_continued(trick: str, server: Server, root: Path) -> None:
    server.tricks[CAN] = [trick]
    assert pulled(root, server).complete
    assert held(root) == FILES
    assert server.ranges(CAN) == [None, f"bytes={len(FILES[CAN]) // 2}-"]


def test_the_next_run_continues_what_this_one_began(server: Server, root: Path) -> None:
    server.tricks[CAN] = ["truncate"]
    report = pulled(root, server, ONCE)
    assert set(report.missing) == set(report.wanting) == {PurePosixPath(CAN)}
    assert CAN not in held(root)
    assert pulled(root, server, ONCE).complete
    assert server.ranges(CAN)[1] == f"bytes={len(FILES[CAN]) // 2}-"
    assert held(root) == FILES


@pytest.mark.parametrize("trick", ["ignore range", "elsewhere"])
def test_a_server_without_ranges_is_listened_to_from_the_beginning(trick: str, server: Server, root: Path) -> None:
    server.tricks[CAN] = ["truncate", trick, "ignore range"]
    assert pulled(root, server).complete
    assert held(root) == FILES


@pytest.mark.parametrize("trick", ["corrupt", "too long", "status 503", "status 429"])
def test_a_passing_fault_is_got_over(trick: str, server: Server, root: Path) -> None:
    server.tricks[CAN] = [trick]
    assert pulled(root, server).complete
    assert held(root) == FILES


@pytest.mark.parametrize(
    ("trick", "reason"),
    [
        ("corrupt", "other content"),
        ("too long", "longer than"),
        ("too short", "no more bytes|interrupted"),
        ("status 503", "503"),
        ("stall", "timed out|Timeout|interrupted"),
    ],
)
def test_a_lasting_fault_leaves_no_file_and_says_why(trick: str, reason: str, server: Server, root: Path) -> None:
    server.always[CAN] = trick
    report = pulled(root, server)
    assert set(held(root)) == set(FILES) - {CAN}
    assert not report.complete
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError(report.missing[PurePosixPath(CAN)])
    assert len(server.ranges(CAN)) == QUICK.attempts


def test_a_server_that_drips_is_given_up(server: Server, root: Path) -> None:
    """Fifty bytes a second would take the can's file ten minutes, and no single byte is late."""
    server.always[CAN] = "drip"
    policy = replace(QUICK, attempts=2, slowest=2000.0, patience=0.3)
    report = pull.pull(root, server.url, manifest=listed(FILES), retry=policy)
    assert "more slowly than 2000 bytes a second" in report.missing[PurePosixPath(CAN)]
    first, second = server.ranges(CAN)
    assert first is None
    assert second is not None  # what came is kept and continued


@pytest.mark.parametrize("name", ["", " "])
def test_an_empty_source_is_refused_and_nothing_is_asked_for(
    name: str, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def network(*_: object) -> None:
        raise AssertionError("the network was asked")

    monkeypatch.setattr(pull, "make_client", network)
    with pytest.raises(PullError, match="expected a folder, an archive or a web address"):
        pull.pull(root, name, manifest=listed(FILES))
    assert not root.exists()
    for option in ("--from", "--to"):
        done = CliRunner().invoke(assets_app, ["pull", "simpler", option, name])
        assert done.exit_code == 2
        assert "is empty" in done.output


@pytest.mark.parametrize("name", ["lock", "part", "copy", "folder"])
def test_links_among_partial_downloads_are_not_followed(name: str, server: Server, root: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "file").write_bytes(b"mine")
    key = hashlib.sha256(FILES[CAN]).hexdigest()
    if name == "folder":
        root.mkdir()
        (root / ".partial").symlink_to(victim)
    else:
        (root / ".partial").mkdir(parents=True)
        (root / ".partial" / ("lock" if name == "lock" else f"{key}.{name}")).symlink_to(victim / "file")
    with pytest.raises(PullError, match=r"link|symbolic"):
        pulled(root, server)
    assert (victim / "file").read_bytes() == b"mine"
    assert [path.name for path in victim.iterdir()] == ["file"]


@pytest.mark.parametrize("kind", ["gz", "xz", "bz2"])
def test_an_archive_that_decompresses_to_endless_zeros_is_refused(
    kind: str, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archives, "_FREE", 1 << 20)
    (tmp_path / "a.tar").write_bytes(tarred({"zeros": bytes(1 << 24)}, kind))
    with pytest.raises(PullError, match="decompresses to more than"):
        pull.pull(root, str(tmp_path / "a.tar"), manifest=listed(FILES))


def test_an_archive_of_more_files_than_any_is_refused(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archives, "MAX_ENTRIES", 2)
    for name, content in (("a.zip", zipped(FILES)), ("a.tar", tarred(FILES, ""))):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(PullError, match="more than 2 entries"):
            pull.pull(root, str(tmp_path / name), manifest=listed(FILES))


def test_a_missing_file_is_asked_for_once(server: Server, root: Path) -> None:
    del server.files[CAN]
    report = pulled(root, server)
    assert "404" in report.missing[PurePosixPath(CAN)]
    assert len(server.ranges(CAN)) == 1


def test_a_file_that_lies_twice_in_the_tree_is_fetched_once(server: Server, root: Path) -> None:
    files = {**FILES, "data/copy.obj": FILES[CAN]}
    server.files = files
    assert pulled(root, server, files=files).complete
    assert held(root) == files
    assert len(server.ranges(CAN)) + len(server.ranges("data/copy.obj")) == 1


def test_a_name_with_odd_characters_is_quoted(server: Server, root: Path) -> None:
    files = {"data/a b#1?.png": b"picture"}
    server.files = {"data/a%20b%231%3F.png": b"picture"}
    assert pulled(root, server, files=files).complete


def test_a_server_that_cannot_be_reached_is_given_up_early(server: Server, root: Path) -> None:
    with Server() as closed:
        url = closed.url
    files = {f"data/{i}.obj": b"%d" % i for i in range(60)}
    report = pull.pull(root, url, manifest=listed(files), retry=ONCE)
    reasons = list(report.missing.values())
    assert len(reasons) == 60
    assert sum("cannot be reached" in reason for reason in reasons) > 30


# Redirections


def test_a_redirection_on_the_same_server_is_followed(server: Server, root: Path) -> None:
    server.files["elsewhere"] = FILES[CAN]
    server.always[CAN] = "redirect /elsewhere"
    assert pulled(root, server).complete
    assert held(root) == FILES


def test_a_redirection_to_another_host_is_refused(server: Server, root: Path) -> None:
    with Server() as outside:
        outside.files[CAN] = FILES[CAN]
        server.always[CAN] = f"redirect http://localhost:{outside.server_port}/{CAN}"
        report = pulled(root, server)
        assert "refused to follow a redirect to http://localhost" in report.missing[PurePosixPath(CAN)]
        assert outside.asked == []


@pytest.mark.parametrize("where", ["file:///etc/hostname", "ftp://127.0.0.1/x"])
def test_a_redirection_to_anything_but_the_web_is_refused(where: str, server: Server, root: Path) -> None:
    server.always[CAN] = f"redirect {where}"
    assert PurePosixPath(CAN) in pulled(root, server).missing
    assert CAN not in held(root)


def test_redirections_in_a_circle_end(server: Server, root: Path) -> None:
    server.always[CAN] = f"redirect /{CAN}"
    assert "more than 5 redirects" in pulled(root, server).missing[PurePosixPath(CAN)]


@pytest.mark.parametrize(
    ("to", "allowed"),
    [
        ("https://codeload.github.com/x.zip", True),
        ("https://github.com/y.zip", True),
        ("http://codeload.github.com/x.zip", False),
        ("https://github.com.example.org/x.zip", False),
        ("https://notgithub.com/x.zip", False),
        ("https://codeload.github.com:8443/x.zip", False),
    ],
)
def test_known_archives_may_redirect_to_their_publishers_hosts_only(to: str, allowed: bool) -> None:
    first, hosts = httpx.URL("https://github.com/haosulab/x.zip"), pull.ARCHIVES[1].hosts
    if allowed:
        check_redirect(first, httpx.URL(to), hosts)
    else:
        with pytest.raises(FileNotInSource, match="refused"):
            check_redirect(first, httpx.URL(to), hosts)


# The folder


@pytest.mark.parametrize("path", ["../x", "/etc/x", "a/../../x", "", "a//b", "./a", "C:/x", "a\\..\\x", "a\0b"])
def test_a_manifest_cannot_lead_out_of_the_tree(path: str, root: Path, tmp_path: Path) -> None:
    row = {"path": path, "size": 1, "sha256": hashlib.sha256(b"x").hexdigest()}
    (tmp_path / "manifest.json").write_text(json.dumps({"commit": "c0ffee", "files": [row]}))
    with pytest.raises(ManifestError, match="not a relative path"):
        read_manifest(tmp_path / "manifest.json")
    with pytest.raises(ManifestError):
        resolve(path, root)


def test_a_link_in_the_tree_cannot_lead_out_of_it(root: Path, tmp_path: Path) -> None:
    source, outside = write(tmp_path / "source", FILES), tmp_path / "outside"
    outside.mkdir()
    (root / "data").mkdir(parents=True)
    (root / "data/custom").symlink_to(outside)
    with pytest.raises(PullError, match="leads out of it"):
        pull.pull(root, str(source), manifest=listed(FILES))
    assert held(outside) == {}


def test_two_runs_do_not_fill_one_folder(server: Server, root: Path) -> None:
    (root / ".partial").mkdir(parents=True)
    with (root / ".partial/lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(PullError, match="another process"):
            pulled(root, server)


def test_a_folder_that_cannot_be_made_is_named(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(PullError, match=r"file/tree"):
        pulled(tmp_path / "file" / "tree", server)


# From a folder or an archive


def test_a_folder_is_copied_where_its_files_are_right(root: Path, tmp_path: Path) -> None:
    source = write(tmp_path / "source", {**FILES, CAN: b"something else"})
    report = pull.pull(root, str(source), manifest=listed(FILES))
    assert set(held(root)) == set(FILES) - {CAN}
    assert "other content" in report.missing[PurePosixPath(CAN)]


def zipped(files: dict[str, bytes]) -> bytes:
    with io.BytesIO() as buffer:
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for path, content in files.items():
                archive.writestr(path, content)
        return buffer.getvalue()


def tarred(files: dict[str, bytes], kind: str) -> bytes:
    with io.BytesIO() as buffer:
        with tarfile.open(fileobj=buffer, mode=f"w:{kind}") as archive:  # pyright: ignore[reportCallIssue, reportArgumentType]
            link = tarfile.TarInfo("robots/arm.urdf")
            link.type, link.linkname = tarfile.SYMTYPE, "/etc/hostname"
            archive.addfile(link)
            for path, content in files.items():
                info = tarfile.TarInfo(path)
                info.size = len(content)
                archive.addfile(info, io.BytesIO(content))
        return buffer.getvalue()


MEMBERS = {f"../../somewhere/else/{path}": content for path, content in FILES.items()}


@pytest.mark.parametrize("kind", ["zip", "", "gz", "xz", "bz2"])
def test_an_archives_files_are_known_by_content_wherever_they_lie(kind: str, root: Path, tmp_path: Path) -> None:
    decoys = {"decoy/collision.obj": b"x" * len(FILES[CAN]), "arm.urdf": b"<Robot/>"}
    members = {**decoys, **MEMBERS}
    archive = tmp_path / ("a.zip" if kind == "zip" else "a.tar")
    archive.write_bytes(zipped(members) if kind == "zip" else tarred(members, kind))
    before = set(tmp_path.rglob("*"))
    assert pull.pull(root, str(archive), manifest=listed(FILES)).complete
    assert held(root) == FILES
    assert all(path == root or root in path.parents for path in set(tmp_path.rglob("*")) - before)


@pytest.mark.parametrize("content", [b"", zipped(FILES)[:200], tarred(FILES, "xz")[:200], b"<html>"])
def test_what_is_not_an_archive_is_named(content: bytes, root: Path, tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(PullError, match=r"a\.zip is not an archive"):
        pull.pull(root, str(tmp_path / "a.zip"), manifest=listed(FILES))


def test_a_damaged_member_is_not_taken(root: Path, tmp_path: Path) -> None:
    content = bytearray(zipped(FILES))
    content[60] ^= 0xFF
    (tmp_path / "a.zip").write_bytes(content)
    report = pull.pull(root, str(tmp_path / "a.zip"), manifest=listed(FILES))
    assert "damaged in" in report.missing[PurePosixPath(CAN)]
    assert set(held(root)) == set(FILES) - {CAN}


def test_a_source_that_does_not_exist_is_named(root: Path, tmp_path: Path) -> None:
    with pytest.raises(PullError, match="nowhere"):
        pull.pull(root, str(tmp_path / "nowhere"), manifest=listed(FILES))


def test_an_archive_on_the_web_is_continued_too(server: Server, root: Path) -> None:
    server.files["all.zip"] = zipped(MEMBERS)
    server.tricks["all.zip"] = ["truncate"]
    report = pull.pull(root, f"{server.url}/all.zip", manifest=listed(FILES), retry=QUICK)
    assert (report.complete, held(root)) == (True, FILES)
    assert server.ranges("all.zip") == [None, f"bytes={len(server.files['all.zip']) // 2}-"]
    assert not (root / ".partial").exists()


def test_what_the_repository_lacks_comes_from_the_archives_that_may_have_it(
    server: Server, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = zipped(FILES)
    server.files = {"c0ffee/robots/arm.urdf": FILES["robots/arm.urdf"], "objects.zip": content}
    monkeypatch.setattr(pull, "REPOSITORY", server.url + "/{commit}/")
    objects = Archive(
        url=f"{server.url}/objects.zip", hosts=(), holds=("data/",), sha256=hashlib.sha256(content).hexdigest()
    )
    robots = Archive(url=f"{server.url}/robots.zip", hosts=(), holds=("robots/",))
    monkeypatch.setattr(pull, "ARCHIVES", (objects, robots))
    report = pull.pull(root, manifest=listed(FILES), retry=QUICK)
    assert (report.complete, held(root)) == (True, FILES)
    assert server.ranges("robots.zip") == []


def test_an_archive_with_another_hash_is_not_opened(
    server: Server, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.files = {"objects.zip": zipped(FILES)}
    monkeypatch.setattr(pull, "REPOSITORY", server.url + "/{commit}/")
    wrong = Archive(url=f"{server.url}/objects.zip", hosts=(), holds=("",), sha256="0" * 64)
    monkeypatch.setattr(pull, "ARCHIVES", (wrong,))
    report = pull.pull(root, manifest=listed(FILES), retry=QUICK)
    assert held(root) == {}
    assert "objects.zip: has other content" in report.missing[PurePosixPath(CAN)]


# Files known by Git's identifier alone


def test_a_file_may_be_known_by_gits_identifier(server: Server, root: Path) -> None:
    """``printf 'hello\\n' | git hash-object --stdin`` prints it."""
    wanted = Entry(path=PurePosixPath("hello.txt"), git_blob="ce013625030ba8dba906f756967f9e9ca394464a")
    manifest = Manifest(commit="c0ffee", files=(wanted,))
    server.files["hello.txt"] = b"hullo\n"
    assert pull.pull(root, server.url, manifest=manifest, retry=ONCE).missing
    server.files["hello.txt"] = b"hello\n"
    assert pull.pull(root, server.url, manifest=manifest, retry=ONCE).complete


def test_a_file_needs_a_hash(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"commit": "c0ffee", "files": [{"path": "a", "size": 1}]}')
    with pytest.raises(ManifestError, match="a has no hash"):
        read_manifest(tmp_path / "manifest.json")


# Command line


def test_the_command_fills_a_folder_and_reports(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = PurePosixPath("data/hab2_bench_assets/stages/bridge_table_1_v1.glb")
    manifest = Manifest(commit="c0ffee", files=(*listed(FILES).files, Entry(path=stage, git_blob="0" * 40)))
    monkeypatch.setattr(pull, "read_manifest", lambda: manifest)
    source = write(tmp_path / "source", FILES)
    monkeypatch.setenv(assets.VARIABLE, str(root))
    done = CliRunner().invoke(assets_app, ["pull", "simpler", "--from", str(source)])
    assert done.exit_code == 0
    assert "3 files fetched, 0 were there, 1 missing" in done.output
    assert "a plain table with its top at z = 0.869532 m stands in" in done.output
    assert held(root) == FILES
    (source / CAN).unlink()
    done = CliRunner().invoke(assets_app, ["pull", "simpler", "--from", str(source), "--to", str(tmp_path / "other")])
    assert done.exit_code == 1
    assert f"missing: {CAN}: not in" in done.output


def test_the_command_names_what_it_cannot_use(tmp_path: Path) -> None:
    unknown = CliRunner().invoke(assets_app, ["pull", "libero"])
    assert (unknown.exit_code, "simpler" in unknown.output) == (2, True)
    nowhere = CliRunner().invoke(
        assets_app, ["pull", "simpler", "--from", str(tmp_path / "nowhere"), "--to", str(tmp_path / "tree")]
    )
    assert nowhere.exit_code == 1
    assert "nowhere" in nowhere.output


def test_the_archive_beside_the_repository_holds_all_but_nine_files(root: Path) -> None:
    if not ARCHIVE.is_file():
        pytest.skip("no archive of SIMPLER's assets beside the repository")
    report = pull.pull(root, str(ARCHIVE))
    assert report.complete
    assert (len(report.fetched), len(report.stand_ins)) == (286, 9)
    assert {path.name for path in report.missing if path.suffix == ".glb"} == {
        f"{name}.glb" for name in ("bridge_table_1_v1", "bridge_table_1_v2", "google_pick_coke_can_1_v4")
    }
