-- Appends segments in one round trip: all or nothing, in the order given.
--
-- Streams and producers come once each; a segment names them by their place, from 1. Payloads and hashes
-- come end to end in one value each, since that is what PostgreSQL takes in fastest.
--
-- Lock the streams' heads in a fixed order, so that two appends cannot wait for each other in a circle;
-- for each segment acknowledge what is already there, refuse what conflicts, chain the hash. Positions come
-- from a one-row counter as the last step before commit, so they are gapless and in commit order; the
-- row lock on the counter is held until commit.
--
-- p_expected: the stream's sequence before this segment, or null to append wherever it stands.
-- p_chain:    the chain hash that must come out, or null; a replica's appends give it.
-- p_base:     null, or for each segment the chain hash before it if it may begin a new run of its stream in a gap or
--             beyond the head, else null.
-- Errors:     VA001 the stream stands elsewhere; VA002 other bytes at the same place;
--             VA003 the chain hash comes out different; VA007 its place is sealed. DETAIL is JSON.
-- Gaps:       where a stream was begun behind its first event, a row of stream_bases says behind which one and how far
--             the run below has come. A segment goes on with the run at the head, or with a run below a base, at most
--             up to the base, where the chain hash must come out as the base's.
-- Hollow:     a segment whose payload comes with no bytes is stored without payload; its hash is of the one it had.
-- Sealed:     a re-sent segment whose place lies in a sealed file is refused with VA007, or, where the caller says
--             p_sealed_is_compared, answered as a duplicate without position: the caller compares it with the
--             file before it commits.
create function append_segments(
  p_epoch          integer[],  -- a stream
  p_station        text[],
  p_source         text[],
  p_type           text[],
  p_producer       text[],     -- a producer
  p_version        text[],
  p_configuration  bytea[],
  p_stream         integer[],  -- a segment
  p_by             integer[],
  p_expected       bigint[],
  p_event_count    integer[],
  p_schema_version integer[],
  p_time_min       timestamptz[],
  p_time_max       timestamptz[],
  p_chain          bytea[],
  p_payload_length integer[],
  p_payload_hashes bytea,
  p_payloads       bytea,
  p_sealed_is_compared boolean,
  p_base           bytea[],
  out positions bigint[], out first_sequences bigint[], out chain_hashes bytea, out duplicates boolean[]
)
language plpgsql security definer set search_path from current set plan_cache_mode = force_generic_plan as $$
declare
  n          constant integer := cardinality(p_stream);
  ids        bigint[];
  sequences  bigint[];
  heads      bytea[];
  prefixes   bytea[];
  suffixes   bytea[];
  firsts     bigint[]  := array_fill(null::bigint, array[n]);
  chains     bytea[]   := array_fill(null::bytea, array[n]);
  s          integer;
  sent_hash  bytea;
  twin       segments;
  above      stream_bases;
  after_hash bytea;
  last       bigint;
  is_held    boolean;
  jumps      integer[] := '{}';
  new_count  integer := 0;
  last_position bigint;
  now_at     timestamptz;
begin
  for attempt in 1 .. 2 loop
    select array_agg(id order by k), array_agg(sequence order by k), array_agg(chain_hash order by k),
        array_agg(prefix order by k)
      into ids, sequences, heads, prefixes
      from (
        select k, x.id, x.sequence, x.chain_hash, 'VIANSEG1'::bytea || int4send(e)
            || substring(int4send(octet_length(t)) from 3) || convert_to(t, 'UTF8')
            || substring(int4send(octet_length(o)) from 3) || convert_to(o, 'UTF8')
            || substring(int4send(octet_length(y)) from 3) || convert_to(y, 'UTF8') as prefix
          from unnest(p_epoch, p_station, p_source, p_type) with ordinality as u(e, t, o, y, k)
          join streams x on x.station = t and x.epoch = e and x.source = o and x.type = y
          order by x.id for update of x
      ) as locked;
    exit when cardinality(ids) = cardinality(p_epoch);
    insert into streams (station, epoch, source, type)
      select t, e, o, y from unnest(p_station, p_epoch, p_source, p_type) as u(t, e, o, y)
      order by 1, 2, 3, 4
      on conflict do nothing;
  end loop;
  for k in 1 .. cardinality(p_producer) loop
    suffixes[k] := header_text(p_producer[k]) || header_text(p_version[k]) || p_configuration[k];
  end loop;
  duplicates := array_fill(false, array[n]);
  positions := array_fill(null::bigint, array[n]);

  for i in 1 .. n loop
    s := p_stream[i];
    sent_hash := substring(p_payload_hashes from 32 * i - 31 for 32);
    after_hash := heads[s];
    is_held := false;
    above := null;
    if p_expected[i] <> sequences[s] then
      -- The base at the upper end of the gap that it lies in, if it lies in one.
      select * into above from stream_bases b
        where b.stream_id = ids[s] and b.filled_sequence < b.sequence and b.sequence > p_expected[i]
        order by b.sequence limit 1;
      if above.filled_sequence > p_expected[i] then
        above := null;
      end if;
      is_held := above.sequence is null and p_expected[i] < sequences[s];
      if p_expected[i] = above.filled_sequence then
        after_hash := above.filled_hash;
      elsif not is_held then
        after_hash := p_base[i];
        if after_hash is null then
          raise exception 'stream % stands at %, expected %', ids[s], coalesce(above.filled_sequence, sequences[s]),
            p_expected[i] using errcode = 'VA001',
            detail = json_build_object('index', i - 1, 'actual', coalesce(above.filled_sequence, sequences[s]));
        end if;
      end if;
    end if;

    if is_held then
      select * into twin from segments g
        where g.stream_id = ids[s] and g.first_sequence <= p_expected[i] + 1
        order by g.first_sequence desc limit 1;
      if twin.first_sequence is null or twin.first_sequence + twin.event_count - 1 < p_expected[i] + 1 then
        if not exists (select from sealed_ranges r
            where r.stream_id = ids[s] and p_expected[i] + 1 between r.first_sequence and r.last_sequence) then
          raise exception 'stream % stands at %, expected %', ids[s], sequences[s], p_expected[i]
            using errcode = 'VA001', detail = json_build_object('index', i - 1, 'actual', sequences[s]);
        elsif not p_sealed_is_compared then
          raise exception 'sequence % of stream % is sealed', p_expected[i] + 1, ids[s] using errcode = 'VA007';
        end if;
        duplicates[i] := true;
        firsts[i] := p_expected[i] + 1;
        chains[i] := decode(repeat('00', 32), 'hex');
        continue;
      elsif twin.first_sequence <> p_expected[i] + 1 or twin.payload_hash <> sent_hash then
        raise exception 'stream % holds other bytes from %', ids[s], p_expected[i] + 1
          using errcode = 'VA002', detail = json_build_object('index', i - 1, 'actual', sequences[s],
            'stored_hash', encode(twin.payload_hash, 'hex'), 'sent_hash', encode(sent_hash, 'hex'));
      end if;
      duplicates[i] := true;
      positions[i] := twin.position;
      firsts[i] := twin.first_sequence;
      chains[i] := twin.chain_hash;
    else
      firsts[i] := coalesce(p_expected[i], sequences[s]) + 1;
      last := firsts[i] + p_event_count[i] - 1;
      -- The header's fixed layout (docs/reference/segment.md), between the previous chain hash and the payload's hash.
      chains[i] := sha256(after_hash || prefixes[s]
        || int8send(firsts[i]) || int4send(p_event_count[i]) || int4send(p_schema_version[i])
        || int8send((extract(epoch from p_time_min[i]) * 1000000)::bigint)
        || int8send((extract(epoch from p_time_max[i]) * 1000000)::bigint)
        || suffixes[p_by[i]] || sent_hash);
      new_count := new_count + 1;
      if above.sequence is not null then
        if last > above.sequence then
          raise exception 'stream % is here already from %', ids[s], above.sequence + 1
            using errcode = 'VA001', detail = json_build_object('index', i - 1, 'actual', above.filled_sequence,
              'until', above.sequence);
        elsif last = above.sequence and chains[i] <> above.chain_hash then
          raise exception 'stream %: chain hash differs at %', ids[s], above.sequence
            using errcode = 'VA003', detail = json_build_object('index', i - 1, 'first_sequence', firsts[i],
              'base', above.sequence);
        end if;
        update stream_bases b set filled_sequence = last, filled_hash = chains[i]
          where b.stream_id = ids[s] and b.sequence = above.sequence;
      end if;
      if p_expected[i] <> coalesce(above.filled_sequence, sequences[s]) then
        jumps := jumps || i;
        insert into stream_bases (stream_id, sequence, chain_hash, position, filled_sequence, filled_hash)
          values (ids[s], p_expected[i], after_hash, 0, coalesce(above.filled_sequence, sequences[s]),
            coalesce(above.filled_hash, heads[s]));
      end if;
      if above.sequence is null then
        sequences[s] := last;
        heads[s] := chains[i];
      end if;
    end if;
    if p_chain[i] <> chains[i] then
      raise exception 'stream %: chain hash differs from %', ids[s], firsts[i]
        using errcode = 'VA003', detail = json_build_object('index', i - 1, 'first_sequence', firsts[i]);
    end if;
  end loop;

  if new_count > 0 then
    update streams x set sequence = u.sequence, chain_hash = u.head
      from unnest(ids, sequences, heads) as u(id, sequence, head)
      where x.id = u.id and x.sequence <> u.sequence;
    update log_head set position = position + new_count,
        -- Under the lock, so that it follows the order of positions, also when the clock is set back.
        recorded_at = greatest(recorded_at, clock_timestamp())
      returning position, recorded_at into last_position, now_at;
    insert into segments (position, stream_id, first_sequence, event_count, schema_version, time_min, time_max,
        recorded_at, producer, producer_version, configuration_hash, payload, payload_hash, chain_hash)
      select last_position - new_count + row_number() over (order by i), ids[st], fs, ec, sv, tmin, tmax, now_at,
        p_producer[pr], p_version[pr], p_configuration[pr],
        nullif(substring(p_payloads from ends::integer - len + 1 for len), ''::bytea), substring(p_payload_hashes from 32 * i::integer - 31 for 32), ch
      from (
        select *, sum(len) over (order by i) as ends
        from unnest(p_stream, p_by, firsts, p_event_count, p_schema_version, p_time_min, p_time_max, p_payload_length,
          chains, duplicates) with ordinality as u(st, pr, fs, ec, sv, tmin, tmax, len, ch, dup, i)
      ) as sent
      where not dup
      order by i;
    select array_agg(case when dup then was else last_position - new_count + fresh end order by i) into positions
      from (
        select dup, was, i, count(*) filter (where not dup) over (order by i) as fresh
        from unnest(duplicates, positions) with ordinality as u(dup, was, i)
      ) as placed;
    if jumps <> '{}' then
      update stream_bases b set position = positions[j]
        from unnest(jumps) as j where b.stream_id = ids[p_stream[j]] and b.sequence = p_expected[j];
    end if;
    perform pg_notify('vian_log', last_position::text);
  end if;
  first_sequences := firsts;
  chain_hashes := string_agg(c, ''::bytea order by i) from unnest(chains) with ordinality as u(c, i);
end $$;
